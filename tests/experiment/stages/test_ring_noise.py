"""What the ring fit is told of the camera's noise, against exposures by that camera.

Detects: a variance off by 3 %, stated errors of the speed off by a fifth with gain on the chip.
"""

import math

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.ring_images import summed
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.likelihood_fit import fit_rings
from lidar_mi.retrieval.rings.model import PixelNoise
from tests.support import ring_reference as reference
from tests.support.ring_models import ring_model

DARK = {"dark_current": 0.0, "full_well": 1e6}
EMCCD, ICCD = {"multiplication": "emccd"}, {"multiplication": "iccd"}
CAMERAS = {
    "ccd": {},
    "coarse digits": {"gain": 12.0},
    "emccd": {**EMCCD, "multiplication_gain": 300.0, "read_noise": 60.0, "gain": 20},
    "iccd": {**ICCD, "multiplication_gain": 30.0, "read_noise": 40.0},
    "response": {"response_rms": 0.05, "bits": None},
    "binned": {**EMCCD, "multiplication_gain": 20, "binning": 2, "response_rms": 0.2},
}
COARSE = {"shape": (195, 240), "pixel": 4 * reference.PIXEL}


@pytest.mark.parametrize("images", [1, 9])
@pytest.mark.parametrize("modes", [8.0, math.inf])
@pytest.mark.parametrize("camera", CAMERAS)
def test_variance_of_a_pixel(camera, modes, images):
    """160 000 pixels: their variance is known to 1 %."""
    ccd = CCD(**{**DARK, **CAMERAS[camera]})
    mean = 40.0 * images
    light = torch.full((400, 400), mean)
    counts = expose(light, summed(ccd, images), 5, modes=images * modes)[0].double()
    noise = pixel_noise(ccd, modes, images)
    stated = float(noise.variance(torch.tensor(mean), torch.tensor(mean)))
    fourth = float(((counts - mean) ** 4).mean()) / stated**2
    sigma = math.sqrt((fourth - 1) / counts.numel())
    assert float(((counts - mean) ** 2).mean()) / stated == pytest.approx(1, abs=4 * sigma)
    assert sigma < 0.01


def test_excess_is_checked():
    for value in (0.9, math.nan, math.inf):
        with pytest.raises(InputError, match=r"excess: .* expected 1 or more"):
            PixelNoise(excess=value)


@pytest.mark.parametrize(
    ("camera", "photons"),
    [
        ("emccd", 2.4e7),
        pytest.param("iccd", 2.4e7, marks=pytest.mark.slow),
        pytest.param("binned", 1e6, marks=pytest.mark.slow),
    ],
)
def test_stated_errors_with_gain(camera, photons):
    """32 images, 500 or 20 photoelectrons a pixel: at the bound, and stated as they scatter."""
    number = 32
    ccd = CCD(**{**DARK, **CAMERAS[camera], "response_rms": 0.0})
    mean = torch.as_tensor(reference.ring_image(20.0, photons, **COARSE))
    noise = pixel_noise(ccd)
    fit = fit_rings(expose(mean, ccd, 7, number), ring_model(**COARSE), noise)
    bound = cramer_rao(ring_model(**COARSE), photons, noise, v_los=20.0)["v_los"]
    score = ((fit.v_los - 20) / fit.v_los_std).numpy()
    assert abs(score.mean()) < 4 / math.sqrt(number)
    assert abs(np.mean(score**2) - 1) < 4 * math.sqrt(2 / number)
    np.testing.assert_allclose(fit.v_los_std, bound, rtol=0.05)
    assert abs(float(fit.chi_square.mean()) - 1) < 0.03
    # Poisson's bound alone would be too small by the root of the excess noise factor
    plain = cramer_rao(ring_model(**COARSE), photons, PixelNoise(noise.read_noise), v_los=20.0)
    assert 1.3 < bound / plain["v_los"] <= math.sqrt(ccd.excess) * 1.001
