"""Robust least squares against scipy's M-estimator and normal equations.

Unit tests. Detect outliers that pull, weights that forget the flow's error, and a fit that stopped
short taken for converged.
"""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from lidar_mi.retrieval.vortices.robust_fit import Misfit, fit, weights

X = np.linspace(0, 4, 60).reshape(6, 10)
NOISE = 0.05


def model(p):
    return p[0] * np.exp(-p[1] * X) + p[2]


def data(outliers=0):
    """Decay with noise (seed 3); so many values are off by 20 to 40 standard deviations."""
    random = np.random.default_rng(3)
    values = model([2.0, 1.2, 0.3]) + NOISE * random.standard_normal(X.shape)
    spoiled = random.choice(X.size, outliers, replace=False)
    values.ravel()[spoiled] += random.uniform(1, 2, outliers)
    return values


def evaluation(values, valid=True):
    def evaluate(p):
        p = p.numpy()
        decay = np.exp(-p[1] * X)
        jacobian = np.stack([decay, -p[0] * X * decay, np.ones_like(X)])
        variance = np.full_like(X, NOISE**2)
        parts = (model(p) - values, jacobian, np.zeros((2, *X.shape)))
        return Misfit(
            *(torch.as_tensor(part) for part in parts),
            torch.as_tensor(np.broadcast_to(valid, X.shape).copy()),
            *(torch.as_tensor(variance) for _ in range(2)),
        )

    return evaluate


START = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)


def fitted(evaluate, allowed=lambda *_: True, iterations=60, tolerance=1e-12):
    return fit(evaluate, START, allowed, 0.0, iterations, tolerance)


@pytest.mark.parametrize("outliers", [0, 6])
def test_solution_is_the_m_estimator(outliers):
    """Huber's, beyond 3 standard deviations: scipy minimises the same loss by another way."""
    values = data(outliers)
    expected = least_squares(
        lambda p: ((model(p) - values) / NOISE).ravel(),
        [1.0, 0.5, 0.0],
        loss="huber",
        f_scale=3.0,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    found = fitted(evaluation(values))
    assert found.converged
    np.testing.assert_allclose(found.parameters, expected.x, atol=1e-4)
    # the decay within 4 standard errors, which outliers of 40 would otherwise exceed
    stderr = np.sqrt(np.diag(np.linalg.inv(found.fisher.numpy())))
    assert (np.abs(found.parameters.numpy() - [2.0, 1.2, 0.3]) < 4 * stderr).all()


def test_normal_matrix_and_cost_without_outliers():
    """sum of J J^T / variance, less beyond 3 standard deviations; mean squared residual in standard
    deviations 1 to 4 times its own, sqrt(2 / 60)."""
    found = fitted(evaluation(data()))
    jacobian = found.misfit.jacobian.flatten(1).numpy()
    size = np.abs(found.misfit.residual.flatten().numpy()) / NOISE
    weighted = jacobian * np.minimum(1, 3 / size) / NOISE**2
    np.testing.assert_allclose(found.fisher, weighted @ jacobian.T, rtol=1e-9)
    assert found.cost == pytest.approx(1, abs=4 * np.sqrt(2 / X.size))


def test_invalid_residuals_have_no_weight():
    values, valid = data(), np.ones(X.shape, bool)
    values[2, 3:8], valid[2, 3:8] = 1e3, False
    whole = fitted(evaluation(data(), valid))
    np.testing.assert_allclose(
        fitted(evaluation(values, valid)).parameters, whole.parameters, rtol=1e-12
    )


def test_weights_in_closed_form():
    """1 / (variance + flow variance g^2), times 3 / size beyond 3 standard deviations."""
    values = [torch.tensor([x], dtype=torch.float64) for x in (6.0, 1.0, 0.25, 0.16)]
    residual, slope, variance, scatter = values
    misfit = Misfit(
        residual,
        torch.ones(1, 1, dtype=torch.float64),
        torch.stack([slope, 0.5 * slope]),
        torch.tensor([True]),
        variance,
        scatter,
    )
    size = 6 / np.sqrt(0.16 + 0.4 * 1.25)
    assert float(weights(misfit, 0.4)) == pytest.approx(3 / size / (0.25 + 0.4 * 1.25))
    assert float(weights(misfit._replace(residual=0 * residual), 0.0)) == pytest.approx(4)
    assert float(weights(misfit._replace(valid=torch.tensor([False])), 0.4)) == 0


def test_a_fit_that_runs_out_of_steps_has_not_converged():
    assert not fitted(evaluation(data()), iterations=2).converged


def test_steps_that_are_not_allowed_are_not_taken():
    """The rate may not exceed 0.8: the fit stays below, and says that it has not converged."""
    tried = []

    def allowed(p, step):
        tried.append(float((p + step)[1]))
        return tried[-1] < 0.8

    found = fitted(evaluation(data()), allowed)
    assert max(tried) > 0.8 and not found.converged
    assert 0.5 < float(found.parameters[1]) < 0.8


def test_parameters_without_influence_stop_the_fit():
    def blind(p):
        misfit = evaluation(data())(p)
        return misfit._replace(jacobian=misfit.jacobian * torch.tensor([1.0, 1, 0])[:, None, None])

    assert not fitted(blind).converged
