"""Strength of the prior from data: random walks of a known step.

Detects: a level that counts as a step, a wrong power of the step, noise taken for structure.
"""

import numpy as np
import pytest

from lidar_mi.inversion.smoothness import precision, strength


@pytest.mark.parametrize("step", [0.05, 0.5])
@pytest.mark.parametrize("level", [0.0, -30.0])
def test_step_of_random_walks_is_found(step, level):
    random = np.random.default_rng(1)
    count, noise = 40, 0.1
    mix = np.eye(count) + 0.2 * np.tri(count)
    information = mix.T @ mix / noise**2
    found = []
    for _ in range(60):
        walk = level + step * np.r_[0, random.normal(size=count - 1)].cumsum()
        data = mix @ walk + noise * random.normal(size=count)
        found.append(strength(information, mix.T @ data / noise**2))
    # a variance of 39 steps, seen through noise: 30 to 50 % of itself each
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - step**2) < 4 * error
    assert error < 0.12 * step**2


def test_constant_profiles_have_no_steps():
    """Most estimates are a hundredth of the variance of the noise or less."""
    random = np.random.default_rng(2)
    found = [strength(np.eye(30) * 100, 100 * 0.1 * random.normal(size=30)) for _ in range(100)]
    assert np.median(found) < 1e-4


def test_precision_is_the_inverse_of_the_walks_covariance():
    walk = np.tril(np.ones((6, 5)), -1)
    # on the space of steps, apart from the level
    np.testing.assert_allclose(walk.T @ precision(6, 0.25) @ walk, np.eye(5) / 0.25, atol=1e-12)
    np.testing.assert_allclose(precision(6, 0.25) @ np.ones(6), 0, atol=1e-12)
