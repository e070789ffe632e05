"""A function of several variables known at some points only: Gaussian process with noise.

Matern 5/2 kernel with a correlation length per variable, constant mean (Rasmussen & Williams 2006,
chapters 2 and 5). Hyperparameters are drawn: their uncertainty is part of that of the result.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]

# Bounds of the hyperparameters' logarithms: lengths in edges of the unit cube, with a normal prior
# about 1; variance of the noise over the function's.
_LENGTHS, _NOISE, _PRIOR_STD = np.log([0.05, 50.0]), np.log([1e-8, 1e3]), 1.5
# Hyperparameters need no more points; the cost of each step is that of a Cholesky factor.
_LEARNING = 256
_FEATURES = 512


@dataclass(frozen=True)
class Process:
    """A Gaussian process with fixed hyperparameters, given values at points.

    points (point, variable): in the unit cube.
    values (point,): of mean 0 and variance 1.
    logs (variable + 1,): natural logarithms of the correlation lengths and of the ratio of noise to
        function.
    """

    points: Array
    values: Array
    logs: Array

    def without_each(self) -> Array:
        """Prediction of each value by the others, mean included (Dubrule 1983)."""
        inverse = linalg.inv(_covariance(self.points, self.logs))
        rows = inverse.sum(axis=0)
        centred = inverse - np.outer(rows, rows) / rows.sum()
        return np.asarray(self.values - centred @ self.values / np.diag(centred))

    def functions(self, places: Array, count: int, rng: np.random.Generator) -> Array:
        """Functions without noise that agree with the values, (place, function).

        Random Fourier features (the spectrum of the kernel is a t distribution of 5 degrees of
        freedom) give functions of the prior; each is corrected at the points (Matheron's rule;
        Wilson et al. 2020).
        """
        lengths, noise = np.exp(self.logs[:-1]), np.exp(self.logs[-1])
        inverse = linalg.inv(_covariance(self.points, self.logs))
        rows = inverse.sum(axis=0)
        mean = rows @ self.values / rows.sum()
        residual = self.values - mean
        std = np.sqrt(residual @ inverse @ residual / len(residual))
        spectrum = rng.standard_normal((_FEATURES, len(lengths))) / lengths
        spectrum /= np.sqrt(rng.chisquare(5, (_FEATURES, 1)) / 5)
        phases = rng.uniform(0, 2 * np.pi, _FEATURES)
        weights = std * np.sqrt(2 / _FEATURES) * rng.standard_normal((_FEATURES, count))
        prior, sampled = (np.cos(x @ spectrum.T + phases) @ weights for x in (self.points, places))
        prior += std * np.sqrt(noise) * rng.standard_normal(prior.shape)
        gain = _matern(places, self.points, lengths) @ inverse
        return np.asarray(mean + sampled + gain @ (self.values[:, None] - mean - prior))


def processes(points: Array, values: Array, count: int, rng: np.random.Generator) -> list[Process]:
    """Processes with hyperparameters drawn from their posterior density, given the values.

    The density is taken as normal about its maximum (Laplace's approximation).
    """
    learning = rng.permutation(len(points))[:_LEARNING]
    sample = points[learning], values[learning]
    variables = points.shape[1]
    starts = np.append(np.zeros(variables), np.log(0.01)), np.full(variables + 1, -1.0)
    bounds = np.array([_LENGTHS] * variables + [_NOISE])
    optima = (
        optimize.minimize(_misfit, start, sample, "L-BFGS-B", jac=True, bounds=bounds)
        for start in starts
    )
    best = min(optima, key=lambda optimum: float(optimum.fun)).x
    spread = _spread(best, *sample)
    drawn = best + rng.standard_normal((count, len(best))) @ spread
    return [Process(points, values, logs) for logs in np.clip(drawn, *bounds.T)]


def _misfit(logs: Array, points: Array, values: Array) -> tuple[float, Array]:
    """Minus twice the log posterior density up to a constant, and its gradient."""
    lengths, noise, count = np.exp(logs[:-1]), np.exp(logs[-1]), len(values)
    factor = linalg.cho_factor(_covariance(points, logs), lower=True, check_finite=False)
    inverse = linalg.cho_solve(factor, np.eye(count), check_finite=False)
    rows = inverse.sum(axis=0)
    residual = values - rows @ values / rows.sum()
    weights = inverse @ residual
    variance = residual @ weights / count
    misfit = count * np.log(variance) + 2 * np.log(np.diag(factor[0])).sum()
    outer = inverse - np.outer(weights, weights) / variance
    distance = _distance(points, points, lengths)
    slope = 5 / 3 * (1 + distance) * np.exp(-distance) * outer
    # the sum of s_ij (x_i - x_j)^2 for a symmetric s
    squares = 2 * (slope.sum(axis=0) @ points**2 - ((slope @ points) * points).sum(axis=0))
    gradient = np.append(squares / lengths**2, noise * np.trace(outer))
    misfit += ((logs[:-1] / _PRIOR_STD) ** 2).sum()
    gradient[:-1] += 2 * logs[:-1] / _PRIOR_STD**2
    return float(misfit), gradient


def _spread(logs: Array, points: Array, values: Array) -> Array:
    """Square root of the hyperparameters' covariance: the curvature of the misfit, inverted."""
    steps = 1e-3 * np.eye(len(logs))
    gradients = [
        _misfit(logs + step, points, values)[1] - _misfit(logs - step, points, values)[1]
        for step in steps
    ]
    curvature = np.array(gradients) / 2e-3
    # of minus twice a log density; the posterior is no wider than the prior
    precision, axes = np.linalg.eigh((curvature + curvature.T) / 4)
    return np.asarray((axes / np.sqrt(np.maximum(precision, _PRIOR_STD**-2))).T)


def _covariance(points: Array, logs: Array) -> Array:
    """Covariance of the values over the function's variance."""
    correlation = _matern(points, points, np.exp(logs[:-1]))
    return correlation + np.exp(logs[-1]) * np.eye(len(points))


def _matern(a: Array, b: Array, lengths: Array) -> Array:
    distance = _distance(a, b, lengths)
    return np.asarray((1 + distance + distance**2 / 3) * np.exp(-distance))


def _distance(a: Array, b: Array, lengths: Array) -> Array:
    return np.asarray(np.sqrt(5) * cdist(a / lengths, b / lengths))
