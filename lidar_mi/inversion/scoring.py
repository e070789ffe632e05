"""Fisher's scoring: the profile that makes counts most probable, given the ratio of all orders."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_mi.inversion.layers import Layers
from lidar_mi.inversion.smoothness import precision, strength

_STEPS, _LONGEST, _SMALL = 60, 0.5, 1e-3
"""Most steps, longest step of a logarithm, and change in standard errors that ends them."""
LEAST_WALK = 1e-6
"""Least variance of a step of the prior: 0.1 % from node to node."""


@dataclass(frozen=True)
class Known:
    """What is known in addition to the counts.

    background: mean counts of a gate without signal.
    calibration_error: relative standard error of the counts per signal, common to all gates.
    reference (nodes,): weights, of sum 1, of the logarithms whose mean is known.
    reference_log, reference_error: that mean and its standard error; an infinite error: it is not
        known.
    """

    background: float
    calibration_error: float
    reference: np.ndarray
    reference_log: float
    reference_error: float


class Fit(NamedTuple):
    """A profile and how well it is known.

    extinction (nodes,): m^-1.
    covariance (nodes, nodes): of its logarithms.
    walk_step: standard deviation of the prior's step.
    monte_carlo_fraction: variance of the renderer over that of the counts, mean of the gates.
    """

    extinction: np.ndarray
    covariance: np.ndarray
    walk_step: float
    monte_carlo_fraction: float


def fit(
    counts: np.ndarray,
    gain: np.ndarray,
    variance: np.ndarray,
    layers: Layers,
    factor: float,
    known: Known,
    start: np.ndarray,
) -> Fit:
    """Most probable profile of the model gain x a(profile), see `Layers`.

    A common error of the calibration multiplies all means: with them as m, it adds e^2 m m^T to
    the covariance, whose inverse is that of Sherman and Morrison (1950, Ann. Math. Statist. 21,
    124). The variance is that of the rendered mean counts, in addition to that of the counts; the
    factor is that of attenuation, the start in m^-1.
    """
    logs, counts = np.log(start), counts.ravel()
    nodes, added = len(start), variance.ravel()
    row, weight = known.reference, known.reference_error**-2
    for _ in range(_STEPS):
        signal, slopes = layers.signal(np.exp(logs), factor)
        mean, slopes = (gain * signal).ravel(), (gain[..., None] * slopes).reshape(-1, nodes)
        total = mean + known.background + added
        residual = counts - known.background - mean
        scaled, onto = slopes / total[:, None], mean / total
        common = known.calibration_error**2
        common /= 1 + common * (mean @ onto)
        information = scaled.T @ slopes - common * np.outer(slopes.T @ onto, slopes.T @ onto)
        score = scaled.T @ residual - common * (slopes.T @ onto) * (onto @ residual)
        information += weight * np.outer(row, row)
        score += weight * row * (known.reference_log - row @ logs)
        walk = max(strength(information, score + information @ logs), LEAST_WALK)
        prior = precision(nodes, walk)
        covariance = np.linalg.inv(information + prior)
        step = covariance @ (score - prior @ logs)
        change = np.abs(step) / np.sqrt(np.diag(covariance))
        logs = logs + step * min(1, _LONGEST / np.abs(step).max())
        if change.max() < _SMALL:
            break
    fraction = float((added / (mean + known.background)).mean())
    return Fit(np.exp(logs), covariance, float(np.sqrt(walk)), fraction)
