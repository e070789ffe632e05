"""The Gaussian process behind sensitivities. Unit tier: against ordinary kriging, point by point.

Detects predictions of a point that use it, drawn functions that miss the values they are given, or
whose spread is not that of kriging.
"""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from lidar_mi.assessment.metrics.surrogate import Process, processes

LENGTHS, NOISE = np.array([0.5, 1.3]), 0.01


def kernel(a, b):
    """Matern 5/2, from its definition."""
    r = cdist(a / LENGTHS, b / LENGTHS)
    return (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r)


def kriging(points, values, place, noise=NOISE):
    """Best linear unbiased prediction, by the system with a multiplier for its mean."""
    count = len(points)
    system = np.ones((count + 1, count + 1))
    system[:count, :count] = kernel(points, points) + noise * np.eye(count)
    system[count, count] = 0
    weights = np.linalg.solve(system, np.append(kernel(points, place[None]), 1.0))
    return weights[:count] @ values


@pytest.fixture
def process():
    points = np.random.default_rng(5).uniform(size=(40, 2))
    values = np.sin(5 * points[:, 0]) + points[:, 1]
    values = (values - values.mean()) / values.std()
    return Process(points, values, np.log([*LENGTHS, NOISE]))


def test_each_value_is_predicted_by_the_others(process):
    rest = [np.delete(np.arange(40), k) for k in range(40)]
    expected = [
        kriging(process.points[r], process.values[r], process.points[k]) for k, r in enumerate(rest)
    ]
    np.testing.assert_allclose(process.without_each(), expected, rtol=1e-8, atol=1e-8)


def test_functions_agree_with_the_values_and_spread_between_them(process):
    points, values = process.points, process.values
    places = np.random.default_rng(6).uniform(size=(15, 2))
    count, std = 600, []
    # features of their own for every 20 functions: their error is no spread of the process
    rng = np.random.default_rng(7)
    drawn = np.concatenate([process.functions(places, 20, rng) for _ in range(count // 20)], axis=1)
    inverse = np.linalg.inv(kernel(points, points) + NOISE * np.eye(40))
    mean = inverse.sum(axis=0) @ values / inverse.sum()
    variance = (values - mean) @ inverse @ (values - mean) / 40
    for place in places:
        k = kernel(points, place[None])[:, 0]
        std.append(np.sqrt(variance * (1 - k @ inverse @ k)))
    expected = [kriging(points, values, place) for place in places]
    error = (drawn.mean(axis=1) - expected) / (np.array(std) / np.sqrt(count))
    assert np.abs(error).max() < 4
    assert np.abs(drawn.std(axis=1) / std - 1).max() < 5 / np.sqrt(2 * count)


def test_without_noise_functions_pass_through_the_values(process):
    exact = Process(process.points, process.values, np.log([*LENGTHS, 1e-8]))
    found = exact.functions(process.points, 5, np.random.default_rng(1))
    np.testing.assert_allclose(found, np.tile(process.values[:, None], 5), atol=2e-3)


def test_hyperparameters_tell_a_wave_from_noise_and_from_a_variable_without_effect():
    rng = np.random.default_rng(11)
    points = rng.uniform(size=(120, 2))
    wave = np.sin(9 * points[:, 0])
    values = wave + 0.5 * wave.std() * rng.standard_normal(120)
    drawn = np.array([one.logs for one in processes(points, values / values.std(), 40, rng)])
    lengths, noise = np.exp(np.median(drawn, axis=0))[:2], np.exp(np.median(drawn[:, 2]))
    assert lengths[1] > 3 * lengths[0]
    # 0.25 of the variance; the process's own is larger than that of a wave it fits
    assert 0.02 < noise < 0.5
