"""Defects of cameras, detectors and scenes: detects vectors called valid that follow them.

And air that is taken for a defect: particles, smooth brightness and air at rest.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import fourier_shift, gaussian_filter

from lidar_mi.retrieval.defects.rest import at_rest
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array
from tests.support.image_defects import METHODS, SORTS, check

SEEDS = range(100, 106)


def shifted_air(seed, moved=(-0.5, 1.0), shape=(90, 120)):
    """Texture of 30 % that moves by z and y, px, in a band-limited periodic image: exactly."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    texture = gaussian_filter(noise, 2, mode="wrap")
    first = 1 + 0.3 * texture / texture.std()
    return first, np.fft.ifft2(fourier_shift(np.fft.fft2(first), moved)).real


@pytest.mark.slow
@pytest.mark.parametrize(
    ("counts", "fraction", "noise", "method"),
    [
        (200.0, 0.01, 0.0, "variational"),
        (20.0, 0.01, 0.0, "variational"),
        (200.0, 0.003, 0.1, "variational"),
        (200.0, 0.01, 0.01, "multipass"),
    ],
)
def test_hot_pixels_do_not_hold_the_air(counts, fraction, noise, method):
    """`variational` was at rest to 0.0005 m/s, and valid everywhere."""
    random, y, z = np.random.default_rng(1), *axes(120, 90)
    pair = shifted_air(1)
    hot = random.random(pair[0].shape) < fraction
    images = [i + noise * random.standard_normal(i.shape) for i in pair]
    clean = retrieve_wind(
        *(data_array(i, y, z) for i in images), 0.1, method, windows=WindowSizes(stride=3)
    )
    images = [np.where(hot, counts, image) for image in images]
    wind = retrieve_wind(
        *(data_array(i, y, z) for i in images), 0.1, method, windows=WindowSizes(stride=3)
    )
    good = (wind.flag == 0).values
    assert good.mean() > 0.9
    assert "at rest" in wind.attrs["defects"]
    for name, true in (("v", 5.0), ("w", -2.5)):
        off, stated = (wind[n].values[good] for n in (name, f"{name}_stderr"))
        assert np.sqrt(np.mean(((off - true) / stated) ** 2)) < 1.5
        assert np.median(stated) < 1.5 * np.median(clean[f"{name}_stderr"].values)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("moved", [(0.0, 0.0), (0.05, 0.1), (0.3, -0.4), (2.2, -1.4)])
def test_air_is_no_defect_however_slow(seed, moved):
    """Nor with noise: of images of 1e4 px one in ten thousand may have a pixel that stands out."""
    random = np.random.default_rng([3, seed])
    pair = [
        torch.as_tensor(i + 0.03 * random.standard_normal(i.shape))
        for i in shifted_air(10 + seed, moved)
    ]
    structure, stray, _ = at_rest(*pair, Windows(tuple(pair[0].shape)))
    assert not structure.any() and not stray.any()


def test_counts_of_few_photons_are_no_defect():
    random = np.random.default_rng(4)
    pair = [torch.as_tensor(random.poisson(0.1 * i).astype(float)) for i in shifted_air(5)]
    structure, _, _ = at_rest(*pair, Windows(tuple(pair[0].shape)))
    assert not structure.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_defect_changes_no_valid_vector(seed):
    assert check(seed, methods=("multipass", "variational")) is None


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "sort"), [(0, "mast"), (5, "border"), (13, "scratches")])
def test_thin_structure_changes_no_valid_vector(seed, sort):
    """Of valid vectors 4 to 13 % were off by three stated errors or more: parts were not found."""
    assert check(seed, sort, "variational") is None


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_no_sort_of_defect_changes_a_valid_vector(method):
    """Of two pairs of each sort: of 208 pairs two break it, four of 52 by chance once in 600."""
    cases = [(seed, sort) for sort in sorted(SORTS) for seed in range(2)]
    broken = [line for seed, sort in cases if (line := check(seed, sort, method))]
    assert len(broken) <= 3, "\n".join(broken)
