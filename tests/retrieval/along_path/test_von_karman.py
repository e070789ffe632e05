"""Covariances of von Karman's turbulence and of its means.

Detects a wrong length, an error of the mixture of eddies, components taken for each other, a mean
or a displacement of the wrong width.
"""

import numpy as np
import pytest
from scipy.special import gamma, kv

from lidar_mi.retrieval.along_path.von_karman import covariance, lattice_covariance, mean_of


def published(r, length):
    """f and g of von Karman's turbulence (Etkin 1972, chapter 13)."""
    q = r / (1.339 * length)
    f = 2 ** (2 / 3) / gamma(1 / 3) * q ** (1 / 3) * kv(1 / 3, q)
    g = f - 2 ** (2 / 3) / gamma(1 / 3) * q ** (4 / 3) * kv(2 / 3, q) / 2
    return f, g


@pytest.mark.parametrize("length", [30.0, 762.0])
def test_correlations_are_the_published_ones(length):
    r = np.array([0.02, 0.3, 1.0, 3.0]) * length
    f, g = published(r, length)
    for component, number in (("u", 0), ("v", 1), ("w", 2)):
        for axis in range(3):
            places = [0.0, 0.0, 0.0]
            places[axis] = r
            expected = f if axis == number else g
            # the rounded constant 1.339 is right to 3e-5
            np.testing.assert_allclose(
                covariance(component, *places, length), expected, rtol=1e-3, atol=1e-3
            )
    assert covariance("w", 0.0, 0.0, 0.0, length) == pytest.approx(1, abs=2e-3)


def test_means_are_those_of_points():
    """Against the mean over pairs of points, drawn from both Gaussians."""
    length, width, swept = 40.0, 4.0, 2.0
    random = np.random.default_rng(1)
    off = random.normal(size=(200_000, 3)) * [0.0, width, width]
    off += swept * random.normal(size=off.shape)
    for component in ("v", "w"):
        at = off + np.array([3.0, 5.0, -2.0])
        drawn = covariance(component, *at.T, length)
        mean = mean_of(width, "gaussian", 1)
        expected = covariance(component, 3.0, 5.0, -2.0, length, mean, swept**2)
        error = drawn.std() / np.sqrt(len(drawn))
        assert abs(drawn.mean() - expected) < 4 * error < 0.002


@pytest.mark.parametrize("component", ["v", "w"])
def test_lattice_is_as_its_nodes(component):
    y, z = np.array([[-9.0, 0.0, 7.0]]), np.array([[-3.0, 4.0]])
    found = lattice_covariance(component, y, z, 40.0, mean_of(3.0, "falling", 1), 4.0)
    at_y, at_z = np.meshgrid(y, z)
    expected = covariance(component, 0.0, at_y, at_z, 40.0, mean_of(3.0, "falling", 1), 4.0)
    np.testing.assert_allclose(found[0], expected, rtol=1e-12)


@pytest.mark.parametrize("times", [1, 2])
def test_the_falling_mean_is_the_mixture(times):
    """Of waves whose mean is not small."""
    mean = mean_of(5.0, "falling", times)
    for k in (0.0, 0.05, 0.1, 0.2):
        mixed = float(np.exp(-(k**2) * mean.variance / 2) @ mean.weight)
        expected = (1 + k**2 * 25 * 3 / 8) ** (-times * 4 / 3)
        assert mixed == pytest.approx(expected, abs=0.01)
