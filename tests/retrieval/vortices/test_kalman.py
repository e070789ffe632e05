"""Filter and smoother against the conditional distribution of a joint Gaussian one. Detects a gain
or a covariance that is not the best linear one, and a covariance that rounding makes negative."""

import numpy as np
import pytest

from lidar_mi.retrieval.vortices import kalman

STATES, MEASURED, STEPS = 5, 3, 6


def spread(random, size, scale=1.0):
    root = random.standard_normal((size, size)) * scale
    return root @ root.T + 0.1 * scale**2 * np.eye(size)


@pytest.mark.parametrize("walk", [0.0, 0.4])
def test_filter_and_smoother_are_the_batch_estimate(walk):
    """All states and measurements are jointly Gaussian: their conditional mean and covariance."""
    random = np.random.default_rng(1)
    transitions = [np.eye(STATES) + 0.3 * random.standard_normal((STATES, STATES)) for _ in "12345"]
    noises = [walk**2 * spread(random, STATES) for _ in transitions]
    errors = [spread(random, MEASURED, 0.5) for _ in range(STEPS)]
    mean, prior = random.standard_normal(STATES), spread(random, STATES, 2.0)
    measured = random.standard_normal((STEPS, MEASURED))
    observed = random.standard_normal((MEASURED, STATES))

    # every state as a linear function of the first and of the walks
    means, rows = [mean], [np.eye(STATES, STATES * STEPS)]
    for k, transition in enumerate(transitions, 1):
        means.append(transition @ means[-1])
        rows.append(transition @ rows[-1] + np.eye(STATES, STATES * STEPS, STATES * k))
    sources = np.zeros((STATES * STEPS,) * 2)
    for k, part in enumerate([prior, *noises]):
        sources[k * STATES : (k + 1) * STATES, k * STATES : (k + 1) * STATES] = part

    def batch(number, known):
        seen = np.concatenate([observed @ row for row in rows[:known]])
        error = np.zeros((MEASURED * known,) * 2)
        for k in range(known):
            error[k * MEASURED : (k + 1) * MEASURED, k * MEASURED : (k + 1) * MEASURED] = errors[k]
        both = rows[number] @ sources @ seen.T
        gain = both @ np.linalg.inv(seen @ sources @ seen.T + error)
        expected = np.concatenate([observed @ mean for mean in means[:known]])
        departure = measured[:known].ravel() - expected
        return means[number] + gain @ departure, rows[number] @ sources @ rows[
            number
        ].T - gain @ both.T

    state, covariance = mean, prior
    filtered, predicted = [], []
    for k in range(STEPS):
        if k:
            state = transitions[k - 1] @ state
            covariance = transitions[k - 1] @ covariance @ transitions[k - 1].T + noises[k - 1]
        predicted.append(state)
        state, covariance = kalman.updated(state, covariance, measured[k], errors[k], observed)
        filtered.append((state, covariance))
        for got, expected in zip(filtered[-1], batch(k, k + 1), strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-10)
    found = filtered[-1]
    for k in range(STEPS - 2, -1, -1):
        found = kalman.smoothed(filtered[k], transitions[k], noises[k], predicted[k + 1], found)
        for got, expected in zip(found, batch(k, STEPS), strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-10)


def test_innovation_in_closed_form():
    prior, error = np.diag([3.0, 5.0, 7.0]), np.diag([1.0, 4.0])
    got = kalman.innovation(np.zeros(3), prior, np.array([2.0, 3.0]), error, np.eye(2, 3))
    assert got == pytest.approx(4 / 4 + 9 / 9)


def test_covariance_stays_positive_where_a_difference_would_not():
    """Nearly exact measurements of what was hardly known: P - K S K^T is rounding, of 3e-8."""
    covariance = np.diag([1e8, 1e8, 1.0]) + 1e8 * np.ones((3, 3))
    state = np.zeros(3)
    for k in range(1, 21):
        state, covariance = kalman.updated(
            state, covariance, np.ones(2), 1e-8 * np.eye(2), np.eye(2, 3)
        )
        assert (covariance == covariance.T).all()
        np.testing.assert_allclose(np.diagonal(covariance)[:2], 1e-8 / k, rtol=1e-3)
        spread = np.sqrt(np.diagonal(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(spread, spread)).min() > 0
