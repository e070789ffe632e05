"""Places of peaks: physics tests against the Cramer-Rao bound and closed forms. Detect a scatter 20
% above the bound, a bias of 25 % of it, and a place given where there is no peak."""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.peak_fit import peak, peaks


def gaussian(x, place, height=5.0, width=8.0):
    return height * np.exp(-(((x - place) / width) ** 2) / 2)


def test_peaks_that_overlap():
    """Two Gaussians of one width on a slope, one width apart: exact when fitted together."""
    x = np.linspace(0, 100, 400)
    values = (
        3 + 0.01 * x + sum(h * np.exp(-(((x - p) / 8) ** 2) / 2) for p, h in ((42, 5), (60, 4)))
    )
    np.testing.assert_allclose(peaks(x, values, [44, 58], 25, slope=True), [42, 60], atol=1e-6)
    assert abs(peak(x, values, 44, 12) - 42) > 0.05
    with pytest.raises(InputError, match="no peak within"):
        peak(x, -values, 44, 12)


def test_scatter_is_that_of_the_bound():
    """White noise s on samples d apart: var = 2 w d s^2 / (sqrt(pi) h^2) of the place, whatever
    else is fitted with it, by symmetry. 300 draws (seed 1): standard deviation to 16 %, mean to a
    quarter of it, both 4 sigma."""
    step, noise, number = 0.5, 0.4, 300
    x = np.arange(0, 100, step)
    rng = np.random.default_rng(1)
    found = np.array(
        [
            peak(x, 3 + gaussian(x, 50.2) + noise * rng.standard_normal(x.shape), 48.0, 32.0)
            for _ in range(number)
        ]
    )
    bound = np.sqrt(2 * 8.0 * step / np.sqrt(np.pi)) * noise / 5.0
    assert found.std() == pytest.approx(bound, rel=4 / np.sqrt(2 * number))
    assert found.mean() == pytest.approx(50.2, abs=4 * bound / np.sqrt(number))


def test_missing_values_are_left_out():
    x = np.linspace(0, 100, 200)
    values = 3 + gaussian(x, 50.2)
    values[95:105] = np.nan
    assert peak(x, values, 48.0, 25.0) == pytest.approx(50.2, abs=1e-6)
    values[:] = np.nan
    with pytest.raises(InputError, match="no peak within 25 of 48"):
        peak(x, values, 48.0, 25.0)


def test_a_peak_far_from_its_start_is_none():
    """Nearer than 0.7 of the reach it is found, further it is not."""
    x = np.linspace(0, 100, 400)
    values = gaussian(x, 50.0, width=5.0)
    assert peak(x, values, 37.0, 20.0) == pytest.approx(50.0, abs=1e-6)
    with pytest.raises(InputError, match="no peak"):
        peak(x, values, 35.0, 20.0)
