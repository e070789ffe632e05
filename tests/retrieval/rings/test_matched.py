"""Speeds read by the score function of a reference, on images made without the program.

Detects: a bias of half a standard error 20 m/s from the reference, error bars that are not the
scatter, a loss of 3 % of the accuracy against the fit of every image, and images that do not follow
the reference but are called read.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.likelihood_fit import difference, fit_rings
from lidar_mi.retrieval.rings.matched import matched_score, read_matched
from lidar_mi.retrieval.rings.model import PixelNoise
from tests.support import ring_reference as reference
from tests.support.ring_models import ring_model

COARSE = {"shape": (195, 240), "pixel": 4 * reference.PIXEL}
CENTRE = (117.0, 99.0)
NOISE = PixelNoise(5)
PHOTONS = 2.4e7
MODEL = ring_model(**COARSE)


def frames(v_los, number, seed, photons=PHOTONS):
    rng = np.random.default_rng(seed)
    mean = reference.ring_image(v_los, photons, CENTRE, **COARSE)
    drawn = [reference.noisy(mean, rng, NOISE.read_noise, np.inf) for _ in range(number)]
    return torch.as_tensor(np.array(drawn, np.float32))


@pytest.fixture(scope="module")
def score():
    return matched_score(fit_rings(frames(60.0, 8, 1), MODEL, NOISE), MODEL, NOISE)


@pytest.mark.parametrize(("v_los", "light"), [(60.0, 1.0), (40.0, 0.85), (75.0, 1.15)])
def test_is_as_accurate_as_a_fit_of_every_image(score, v_los, light):
    """64 images: std known to 9 %, mean to 12 % of it; each within 4 sigma."""
    images = frames(v_los, 64, 2, light * PHOTONS)
    found, fit = read_matched(images, score), fit_rings(images, MODEL, NOISE)
    assert found.read.all()
    bound = cramer_rao(MODEL, light * PHOTONS, NOISE, v_los=v_los, centre=CENTRE)["v_los"]
    assert abs(float(found.v_los.mean()) - v_los) < 4 * bound / 8
    assert abs(float(found.v_los.std()) / bound - 1) < 4 / np.sqrt(2 * 64)
    # of the same noise: what the reference's weights lose is far below it
    assert float(((found.v_los - fit.v_los) / bound).pow(2).mean()) < 0.03
    torch.testing.assert_close(found.v_los_std, fit.v_los_std, rtol=0.03, atol=0)
    # 64 images of some 2000 cells each
    assert abs(float(found.chi_square.mean()) - 1) < 0.02


def test_no_noise_no_error(score):
    """To the last step of the iteration, a thirtieth of 0.4 standard errors."""
    speeds = np.array([40.0, 55.0, 60.0, 80.0])
    images = torch.as_tensor(
        np.stack([reference.ring_image(v, PHOTONS, CENTRE, **COARSE) for v in speeds])
    )
    found = read_matched(images, score)
    assert np.abs(found.v_los.numpy() - speeds).max() < 0.02 * float(found.v_los_std.max())


def test_differences_to_the_laser_take_what_is_read(score):
    images = frames(62.0, 4, 4)
    found, laser = read_matched(images, score), read_matched(frames(60.0, 4, 5), score)
    v, std, systematic = difference(found, laser)
    assert (abs(v - 2.0) < 5 * std).all() and (systematic == 0).all()
    torch.testing.assert_close(std, torch.hypot(found.v_los_std, laser.v_los_std))


def test_images_that_do_not_follow_are_not_read(score):
    images = frames(60.0, 5, 6)
    images[1, 100:120] *= 1.5
    images[2] = images[2].flip(0)[:, torch.randperm(240, generator=torch.Generator())]
    images[3, 5, 5] = torch.nan
    images[4] = frames(300.0, 1, 7)[0]
    found = read_matched(images, score)
    assert found.read.tolist() == [True, False, False, False, False]
    assert torch.isinf(found.v_los_std[1:]).all() and torch.isfinite(found.v_los_std[0])


@pytest.mark.parametrize("shape", [(2, 100, 100), (195, 240)])
def test_wrong_shapes_are_named(score, shape):
    with pytest.raises(InputError, match="images: shape"):
        read_matched(torch.ones(shape), score)
