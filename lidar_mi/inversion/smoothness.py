"""Prior of a profile: a random walk whose strength is estimated from the counts."""

import numpy as np
import scipy

from lidar_mi.retrieval.likelihood.reml import most_likely


def strength(information: np.ndarray, score: np.ndarray) -> float:
    """Variance of a random walk's step, by restricted maximum likelihood.

    A profile of logarithms is b + s w with a free level b and a random walk w of unit steps. With
    Gaussian estimates of the information I, the combinations of the walk that are independent a
    priori and in the data have squares of the expectation 1 + s^2 g, of which
    `reml.most_likely` finds s^2. The level takes no part: it is fitted (Patterson and Thompson
    1971, Biometrika 58, 545). The estimate without prior, of which the score is I times, need not
    exist.
    """
    count = len(score)
    walk = np.tril(np.ones((count, count - 1)), -1)
    level = np.ones(count)
    total = level @ information @ level
    # residuals about the fitted level
    projected = information - np.outer(information @ level, level @ information) / total
    residual = score - information @ level * (level @ score) / total
    gains, vectors = scipy.linalg.eigh(walk.T @ projected @ walk)
    known = gains > 1e-12 * gains.max()
    gains = gains[known]
    squares = (vectors[:, known].T @ (walk.T @ residual)) ** 2 / gains
    _, factors = most_likely(squares, gains[None], np.full(1, np.inf), 0.5, 1.0)
    return float(factors[0])


def precision(count: int, variance: float) -> np.ndarray:
    """Inverse covariance of a random walk with a free level, (nodes, nodes)."""
    steps = np.diff(np.eye(count), axis=0)
    return steps.T @ steps / variance
