"""The number of Monte Carlo samples of an image.

Detects: a fraction that is not mean variance over variance, a number that misses the fraction asked
for by 20 %, that falls where it must rise, or that exceeds its limit; statistics of the wrong gate.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.rendering.samples import (
    LEAST,
    choose_samples,
    monte_carlo_fraction,
    noise_ratio,
    pilot_samples,
)
from lidar_mi.rendering.settings import RenderSettings

DIMS = ("gate", "z", "y")


def scan(of_one, detected, samples):
    """Variance of one sample over that of a detector, by beam and gate."""
    of_one, detected = np.broadcast_arrays(np.asarray(of_one, float), np.asarray(detected, float))
    simulated = np.sqrt(of_one * detected / samples)
    return xr.Dataset({"S0_stderr": (DIMS, simulated), "S0_noise_std": (DIMS, np.sqrt(detected))})


def ratios(seed=1, shape=(1, 40, 50), mean=100.0):
    """Skewed, as where a wake is bright."""
    return mean * np.random.default_rng(seed).gamma(0.5, 2.0, shape)


def chosen(of_one, samples=32, **settings):
    return choose_samples(scan(of_one, 3.0, samples), samples, RenderSettings(**settings))


@pytest.mark.parametrize("asked", [0.02, 0.1, 1.0])
def test_the_fraction_asked_for_is_reached(asked):
    """By the mean over beams and its two standard errors, rounded up to two digits."""
    of_one = ratios()
    found = chosen(of_one, monte_carlo_fraction=asked, max_samples=1e12)
    mean, error = of_one.mean(), of_one.std() / np.sqrt(of_one.size)
    assert found.reached
    assert mean / asked < found.number < 1.11 * (mean + 2 * error) / asked
    image = scan(of_one, 3.0, found.number)
    assert monte_carlo_fraction(image) == pytest.approx(found.fraction)
    assert np.median(noise_ratio(image)) == pytest.approx(found.median)
    assert np.quantile(noise_ratio(image), 0.9) == pytest.approx(found.upper)
    # other beams of the same air
    assert monte_carlo_fraction(scan(ratios(2), 3.0, found.number)) < 1.1 * asked


def test_the_mean_ratio_limits_what_a_weighted_fit_loses():
    """Information of pixels of variances d + m, against that without the simulation's m."""
    random = np.random.default_rng(3)
    for _ in range(50):
        detected = random.gamma(0.7, 1.0, (1, 8, 9)) + 1e-3
        found = scan(random.gamma(0.3, 1.0, detected.shape), detected, 1)
        simulated = found["S0_stderr"].values ** 2
        slopes = random.standard_normal(detected.shape) ** 2
        whole, alone = ((slopes / v).sum() for v in (detected + simulated, detected))
        by_pixel = (detected / (detected + simulated)).mean()
        assert 1 / by_pixel <= 1 + monte_carlo_fraction(found)
        assert whole <= alone


def test_a_smaller_fraction_takes_more_samples_and_a_limit_as_many_as_it_allows():
    of_one = ratios()
    numbers = [
        chosen(of_one, monte_carlo_fraction=f, max_samples=1e12).number
        for f in (10, 1, 0.3, 0.1, 0.03, 0.001)
    ]
    assert numbers == sorted(numbers) and len(set(numbers)) == len(numbers)
    limited = chosen(of_one, max_samples=400 * of_one.size)
    assert limited.number == 400 and not limited.reached
    assert limited.fraction == pytest.approx(of_one.mean() / 400)
    assert limited.needed == chosen(of_one, max_samples=1e12).number
    fixed = chosen(of_one, samples_per_beam=64)
    assert fixed.number == 64 and fixed.needed == limited.needed


def test_a_detector_of_large_noise_takes_few():
    found = chosen(ratios(mean=1e-4))
    assert found.number == found.needed == LEAST and found.reached
    several = choose_samples(
        scan(ratios(shape=(3, 4, 5), mean=1e-4), 1.0, 96), 96, RenderSettings(), least=100
    )
    assert several.number == 102  # of every gate the same


def test_the_gate_with_the_largest_ratio_decides():
    of_one = ratios(shape=(3, 30, 40)) * np.array([1.0, 5.0, 0.1])[:, None, None]
    found = chosen(of_one, max_samples=1e12)
    # samples of a beam are distributed over its gates
    alone = chosen(of_one[1:2] / 3, max_samples=1e12)
    assert found.number == pytest.approx(3 * 3 * alone.number / 3, rel=0.1)
    assert monte_carlo_fraction(scan(of_one, 1.0, 10)) == pytest.approx(of_one[1].mean() / 10)


def test_dark_pixels_and_detectors_without_noise():
    of_one = ratios()
    dark = scan(of_one, 3.0, 8)
    dark["S0_noise_std"][0, 0, 0] = 0.0
    expected = of_one.ravel()[1:].mean() / 8
    assert monte_carlo_fraction(dark) == pytest.approx(expected)
    none = scan(of_one, 0.0, 8)
    assert monte_carlo_fraction(none) == np.inf
    found = choose_samples(none, 8, RenderSettings(max_samples=2e6))
    assert found.number == 1000 and not found.reached


@pytest.mark.parametrize(("beams", "gates"), [(30_000, 1), (100, 1), (30_000, 24), (1, 1)])
def test_a_pilot_is_small(beams, gates):
    samples = pilot_samples(RenderSettings(max_samples=1e8), beams, gates)
    assert samples % gates == 0 and 4 <= samples / gates <= 32
    assert samples * beams <= 1e8 / 16


def test_numbers_without_a_detector():
    assert RenderSettings().without_detector(24) == 24 * 64
    assert RenderSettings(samples_per_beam=10).without_detector(24) == 10
