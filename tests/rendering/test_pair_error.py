"""The part of a Monte Carlo error that a second image does not share.

Detects: a fraction of the variance that is wrong by 5 sigma, of errors that are independent, that
move with the air, and that do so in part; pixels without an error that count.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from lidar_mi.rendering.pair_error import pair_stderr, unshared_fraction

SHAPE = (80, 90)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)


def errors(seed):
    """Of unit variance, as smooth as a beam makes them."""
    field = gaussian_filter(np.random.default_rng(seed).standard_normal((100, 110)), 2)
    return field / field.std()


@pytest.mark.parametrize("fraction", [0.0, 0.1, 1.0])
def test_the_fraction_is_that_of_the_variance_that_does_not_move(fraction):
    """Displaced by 3.3 and -2.6 px; a field of 2800 px of correlation length 2 has 60 numbers."""
    shared, first, second = errors(1), errors(2), errors(3)
    at = np.arange(100.0), np.arange(110.0)
    moved = xr.DataArray(shared, dict(zip("zy", at, strict=True)), ("z", "y")).interp(
        z=10 + ROWS[:, 0] - 3.3, y=10 + COLUMNS[0] + 2.6, method="cubic"
    )
    same, own = np.sqrt(1 - fraction), np.sqrt(fraction)
    inner = np.s_[10:90, 10:100]
    one = same * shared[inner] + own * first[inner]
    two = same * moved.values + own * second[inner]
    found = unshared_fraction(one, two, np.ones(SHAPE), ROWS + 3.3, COLUMNS - 2.6)[16:-16, 16:-16]
    assert found.mean() == pytest.approx(fraction, abs=5 * fraction * np.sqrt(2 / 60) + 1e-3)


def test_pixels_without_an_error_do_not_count():
    one, two = errors(1)[:80, :90], errors(2)[:80, :90]
    whole = unshared_fraction(one, two, np.ones(SHAPE), ROWS, COLUMNS)
    holes = two.copy()
    holes[:, 40:43] = np.nan
    found = unshared_fraction(one, holes, np.ones(SHAPE), ROWS, COLUMNS)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:, :20], whole[:, :20])
    nothing = unshared_fraction(one, np.full(SHAPE, np.nan), np.ones(SHAPE), ROWS, COLUMNS)
    assert (nothing == 1).all()


def test_images_of_independent_numbers_share_nothing():
    scan = xr.Dataset({"S0_stderr": 2.0})
    assert pair_stderr(scan) == 2 and pair_stderr(scan.assign(S0_pair_stderr=0.5)) == 0.5
