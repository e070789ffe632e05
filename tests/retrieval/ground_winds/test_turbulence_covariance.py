"""Covariance of isotropic turbulence. Physics tier.

Detects: correlations that are not those of the spectrum, a tensor with a wrong direction, averages
that are not those of the tensor.
"""

import numpy as np
import pytest
import scipy

from lidar_mi.atmosphere.air.turbulence import energy_spectrum, turbulence
from lidar_mi.retrieval.ground_winds.turbulence_covariance import (
    correlations,
    of_average,
    of_lines,
    with_average,
)

LENGTH = 120.0


@pytest.mark.parametrize("distance", [1.0, 20.0, 100.0, 400.0])
def test_correlations_are_those_of_the_spectrum(distance):
    """f = 2 int E (sin q / q^3 - cos q / q^2) dk with q = k r, over the variance 1."""
    along, across = correlations(np.array(distance), LENGTH)
    k = np.geomspace(1e-6, 60 / min(distance, 10.0) + 60, 400_000)

    def longitudinal(r):
        q = k * r
        kernel = np.where(q < 0.01, 1 / 3 - q**2 / 30, np.sin(q) / q**3 - np.cos(q) / q**2)
        return 2 * scipy.integrate.simpson(
            k * energy_spectrum(k, 1.0, LENGTH, "von_karman") * kernel, np.log(k)
        )

    assert along == pytest.approx(longitudinal(distance), abs=2e-3)
    # without divergence: g = f + r f' / 2
    step = 0.01 * distance
    slope = (longitudinal(distance + step) - longitudinal(distance - step)) / (2 * step)
    assert across == pytest.approx(longitudinal(distance) + distance / 2 * slope, abs=3e-3)


def test_the_integral_scale_along_the_wind_is_the_length():
    r = np.linspace(0, 30 * LENGTH, 60_000)
    along, _ = correlations(r, LENGTH)
    assert scipy.integrate.simpson(along, r) == pytest.approx(LENGTH, rel=2e-3)


def test_covariances_of_lines_and_of_an_average_are_those_of_realisations():
    random = np.random.default_rng(3)
    places = 80 * random.standard_normal((5, 3))
    lines = random.standard_normal((5, 3))
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    path = np.linspace([0, 0, 0], [90, -30, 10], 12)
    samples = []
    for seed in range(700):
        air = turbulence(1.0, LENGTH, seed)
        seen = np.einsum("ia,ia->i", np.stack(air.velocity(*places.T, 0.0), -1), lines)
        samples.append(np.append(seen, np.stack(air.velocity(*path.T, 0.0), -1).mean(0)))
    samples = np.array(samples)
    found = samples.T @ samples / len(samples)
    # of products of unit normal numbers with correlation c: sqrt((1 + c^2) / n)
    limit = 4.5 * np.sqrt(2 / len(samples))
    assert np.abs(found[:5, :5] - of_lines(places, lines, LENGTH)).max() < limit
    assert np.abs(found[:5, 5:] - with_average(path, places, lines, LENGTH)).max() < limit
    assert np.abs(found[5:, 5:] - of_average(path, LENGTH)).max() < limit
