"""Unrelated images give no wind: detects more than 1 % of valid vectors, and valid ones lost.

Textures, sizes, templates and seeds are none of those that the test of relation was tried on.
"""

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.ndimage import gaussian_filter
from scipy.stats import binom

from benchmarks.cases import vortex_pair_images
from lidar_mi.flags import Flag
from lidar_mi.retrieval.defects.unrelated import unrelated
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.volume import retrieve_wind_volume
from tests.support.flows import axes, data_array

DT = 0.1
# columns, rows, correlation length, template, search
CASES = [(57, 45, 2.0, 8, 16), (83, 52, 4.5, 8, 18), (131, 66, 2.5, 10, 20), (72, 90, 8.0, 12, 24)]


def images(seed, columns, rows, length, noise=0.0, number=2):
    """Textures that have nothing in common."""
    random = np.random.default_rng([seed, 77])
    white = random.standard_normal((number, rows + 40, columns + 40))
    smooth = gaussian_filter(white, (0, length / 2, length / 2))[:, 20:-20, 20:-20]
    smooth *= 0.2 / smooth.std()
    noises = noise * random.standard_normal(smooth.shape)
    return [data_array(1 + air, *axes(columns, rows)) for air in smooth + noises]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "cases", "repeats"),
    [
        ("cc", CASES, 2),
        ("ws", CASES, 2),
        pytest.param("multipass", CASES, 2, marks=pytest.mark.slow),
        ("variational", CASES[:2], 1),
    ],
)
def test_unrelated_images_give_no_valid_vector(method, cases, repeats):
    """A rate of 1e-3: one of 16 images has a chance of 1.6 %, two of 1e-4."""
    valid = []
    for number, (*shape, template, search) in enumerate(cases):
        for repeat in range(repeats):
            pair = images(100 * number + repeat, *shape, noise=0.05 * (repeat % 2))
            wind = retrieve_wind(
                *pair, DT, method, windows=WindowSizes(template=template, search=search, stride=3)
            )
            valid.append(float((wind.flag == 0).mean()))
            different = (wind.flag & Flag.UNRELATED.value) > 0
            faint = (wind.flag & Flag.LOW_TEXTURE.value) > 0
            # these images have texture: its lack is no reason
            assert float(faint.where(different).mean()) < 0.05
    assert np.mean(valid) < 0.01
    assert binom.sf(np.count_nonzero(valid) - 1, len(valid), 1e-3) > 1e-3


@pytest.mark.slow
def test_rate_of_false_alarms():
    """A rate of 5 % is kept: of 60 images as many look related as the binomial allows (4 sigma)."""
    number, observed = 60, 0.0
    for seed in range(number):
        pair = [torch.as_tensor(i.values) for i in images(1000 + seed, 61, 50, 2.2)]
        apart = unrelated(pair, Windows((50, 61), 8, 16, 6), False, false_alarm=0.05)
        observed += 1 - float(apart.double().mean())
    assert observed < number * 0.05 + 4 * np.sqrt(number * 0.05 * 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.06])
def test_related_images_lose_no_vector(noise):
    """Vortices, noise of up to 1/3 of the texture: every vector is where images are related."""
    for seed, columns, rows, length in ((21, 60, 52, 2.2), (22, 111, 77, 4.0)):
        pair = vortex_pair_images(noise, seed, columns, rows, correlation_length=length)
        pixels = [torch.as_tensor(i.values) for i in (pair.first, pair.second)]
        for wide in (False, True):
            assert not bool(unrelated(pixels, Windows((rows, columns), 8, 16, 1), wide).any())


def test_the_unrelated_half_of_an_image_is_flagged():
    first, other = images(31, 190, 80, 3.0)
    second = xr.where(first.y < 0, first.roll(y=2), other).transpose("z", "y")
    wind = retrieve_wind(first, second, DT, "cc", windows=WindowSizes(stride=4))
    flagged = (wind.flag & Flag.UNRELATED.value) > 0
    # a region of windows reaches 24 px to both sides
    assert float((wind.flag.where(wind.y > 12, drop=True) == 0).mean()) < 0.01
    assert not bool(flagged.where(wind.y < -12, drop=True).fillna(0).any())
    assert float((wind.flag.where(wind.y < -12, drop=True) == 0).mean()) > 0.9


def test_brightness_and_holes_do_not_matter():
    pair = vortex_pair_images(0.02, 23, 101, 83)
    first, second = (torch.as_tensor(i.values) for i in (pair.first, pair.second))
    second = 7.0 * second + 300.0
    second[20:30, 50:60] = torch.nan
    assert not bool(unrelated([first, second], Windows((83, 101), 8, 16, 4), True).any())


@pytest.mark.slow
def test_volumes():
    random = np.random.default_rng(41)
    shape = 18, 40, 44
    fields = [
        2 + gaussian_filter(random.normal(size=(18, 40, 46)), 1.6, mode="wrap") for _ in range(2)
    ]
    y = {d: (d, 0.5 * np.arange(n), {"units": "m"}) for d, n in zip("xzy", shape, strict=True)}
    first, moved, other = (
        xr.DataArray(f[..., s : s + 44], y, tuple("xzy"))
        for f, s in ((fields[0], 1), (fields[0], 0), (fields[1], 0))
    )
    good, bad = (
        retrieve_wind_volume(first, second, DT, method="correlation") for second in (moved, other)
    )
    assert not bool((good.flag & Flag.UNRELATED.value).any())
    assert float((good.flag == 0).mean()) > 0.9
    assert float((bad.flag == 0).mean()) < 0.01
