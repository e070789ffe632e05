"""The study of resolution, at one size.

Detects: a bound that leaves an unknown out or is for another instrument, a fit or a method that
sees another speed than the frames have, a size that the table lacks.
"""

import math

import pytest

from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.retrieval.rings.bound import cramer_rao
from validation import resolution
from validation.resolution import Errors

CCD, EMCCD = resolution.CAMERAS.values()


@pytest.mark.slow
def test_bound_is_that_of_the_model():
    model = resolution.nominal(resolution.INSTRUMENT.binned(10))[0]
    for camera in (CCD, EMCCD):
        noise = pixel_noise(camera)
        settings = {"v_los": resolution.SPEED, "free": resolution.FREE}
        own = cramer_rao(model, resolution.PHOTONS, noise, **settings)["v_los"]
        assert resolution.bound(10, noise) == pytest.approx(own, rel=5e-3)
    # and all pixels are bright here: the excess noise is all that differs
    ratio = resolution.bound(10, pixel_noise(EMCCD)) / resolution.bound(10, pixel_noise(CCD))
    assert ratio == pytest.approx(math.sqrt(EMCCD.excess), rel=0.02)


def test_errors_at_one_size():
    least = resolution.bound(10, pixel_noise(CCD))
    found = resolution.fitted(10, CCD, 24, 1)
    assert found.number == 24 and abs(found.bias) < 4 * least / math.sqrt(24) + 0.03
    assert found.std == pytest.approx(least, abs=4 * least / math.sqrt(48))
    assert found.stated == pytest.approx(least, rel=0.02)
    paper = resolution.of_the_paper(10, CCD, 2, 1)
    assert resolution.rms(paper["ca_r2"]) < 5 and paper["ca_r2"].number == 2


def test_table_and_figure(tmp_path):
    one = Errors(0.01, 0.1, 8, 0.1)
    sizes = [(camera, factor) for camera in resolution.CAMERAS for factor in resolution.FACTORS]
    bounds, fits = dict.fromkeys(sizes, 0.09), dict.fromkeys(sizes, one)
    lost = Errors.of([math.nan, math.nan])
    paper = {key: {"ca_r2": one, "ml": one, "sg": lost} for key in resolution.FACTORS}
    resolution.draw(tmp_path / "pictures" / "resolution.png", bounds, fits, paper)
    assert (tmp_path / "pictures" / "resolution.png").stat().st_size < 80_000
    lines = resolution.table(bounds, fits, paper)
    assert len(lines) == 2 + len(resolution.FACTORS)
    assert lines[-1].startswith("| 32 x 26 | 0.090 | 0.100, +0.010 |") and lines[-1].endswith("- |")


def test_errors():
    found = Errors.of([resolution.SPEED + 1, math.nan, resolution.SPEED - 3], [0.2, 0.2, 0.2])
    assert (found.bias, found.number) == (-1, 2) and found.std == pytest.approx(math.sqrt(8))
    assert resolution.rms(found) == pytest.approx(3)
