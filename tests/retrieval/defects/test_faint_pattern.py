"""A faint pattern at rest all over the images: detects biases that no standard error states.

Seeds are none of those that the limits were tried on.
"""

from functools import partial

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.flags import Flag
from lidar_mi.retrieval.defects.faint_pattern import Standing, standing
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array, origin, plane_waves, texture

Y, Z = axes(130, 114)
GRID = np.meshgrid(Y, Z)
WIND = partial(velocity, vortex_pair(400.0, separation=30.0, core_radius=3.0))
NOISE = 0.01


def images(seed, pattern=0.0, replaced=0.0):
    """Texture of 20 % in a vortex pair, times a pattern; image 2 is partly of other air."""
    waves = [plane_waves(seed + step, 3.0, 0.5) for step in (0, 1000, 2000)]
    first, second = texture(waves[0], *GRID), texture(waves[0], *origin(WIND, *GRID, 0.1))
    other = texture(waves[1], *GRID)
    second = 1 + np.sqrt(1 - replaced) * (second - 1) + np.sqrt(replaced) * (other - 1)
    gain = texture(waves[2], *GRID, contrast=pattern)
    random = np.random.default_rng([seed, 1])
    return [i * gain + NOISE * random.standard_normal(i.shape) for i in (first, second)]


def true_displacement():
    """In pixels, and the windows."""
    windows = Windows((len(Z), len(Y)), 2, 4, 1)
    y, z = (a[0] + 0.5 * windows.centres(n).numpy() for n, a in ((1, Y), (0, Z)))
    v, w = WIND(*np.meshgrid(y, z))
    d = torch.as_tensor(np.stack([w, v]) * 0.1 / 0.5)
    covariance = torch.zeros(2, 2, *windows.count, dtype=torch.float64)
    zero = torch.zeros(windows.count)
    return Displacement(d, zero, zero.to(torch.int16), covariance), windows


def found_in(pair):
    return standing([torch.as_tensor(i) for i in pair], *true_displacement())


@pytest.mark.parametrize("pattern", [0.05, 0.1])
def test_fraction_of_the_squared_gradients(pattern):
    """Of known displacements the fraction is that of the variances, of one spectrum."""
    found = found_in(images(71, pattern))
    expected = pattern**2 / (0.2**2 + pattern**2)
    # finite displacements and a pattern that the texture modulates reduce it by some 20 %
    assert found.fraction == pytest.approx(expected, abs=3 * found.stderr + 0.25 * expected)
    assert 0 < found.stderr < 0.3 * expected


@pytest.mark.parametrize("replaced", [0.0, 0.1, 0.3])
def test_other_air_is_no_pattern(replaced):
    assert found_in(images(72, replaced=replaced)) == Standing()


def test_still_air_and_small_images_show_none():
    pair = [torch.as_tensor(i) for i in images(73, 0.05)]
    found, windows = true_displacement()
    assert standing(pair, found._replace(d=0.01 * found.d), windows) == Standing()
    hole = [torch.where(torch.arange(len(Y)) > 40, torch.nan, i) for i in pair]
    assert standing(hole, found, windows) == Standing()


def test_correction_divides_by_the_rest():
    found, _ = true_displacement()
    corrected = Standing(0.05, 0.01).corrected(found)
    torch.testing.assert_close(corrected.d, found.d / 0.95)
    along, across = corrected.covariance[0, 0], corrected.covariance[0, 1]
    expected = (0.01**2 + (0.4 * 0.05) ** 2) * corrected.d.square().sum(0)
    torch.testing.assert_close(along, expected)
    assert not across.any()
    assert Standing(0.2, 0.01).spoils
    assert Standing(0.2, 0.01).corrected(found) is found


def retrieved(pair, method):
    return retrieve_wind(
        *(data_array(i, Y, Z) for i in pair),
        0.1,
        method,
        windows=WindowSizes(stride=3),
        noise=NOISE,
    )


@pytest.mark.slow
def test_standard_errors_hold_with_a_pattern():
    """Without the correction the normalised errors have a variance of 3."""
    wind = retrieved(images(74, 0.05), "variational")
    assert wind.attrs["standing_fraction"] == pytest.approx(0.05, abs=0.02)
    valid = wind.flag.values == 0
    true = dict(zip("vw", WIND(*np.meshgrid(wind.y.values, wind.z.values)), strict=True))
    score = np.concatenate(
        [((wind[n].values - true[n]) / wind[f"{n}_stderr"].values)[valid] for n in "vw"]
    )
    assert valid.mean() > 0.9
    assert np.mean(score**2) < 1.7


@pytest.mark.parametrize(
    ("pattern", "method"),
    [pytest.param(0.1, "variational", marks=pytest.mark.slow), (0.05, "vortex_fit")],
)
def test_uncorrected_fields_are_flagged(pattern, method):
    """A strong pattern, or parameters that the correction of vectors does not reach."""
    wind = retrieved(images(75, pattern), method)
    assert ((wind.flag.values & Flag.AT_REST.value) > 0).all()
