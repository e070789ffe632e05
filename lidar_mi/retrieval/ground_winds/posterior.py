"""Mean wind over the lines of a scan: noise and turbulence as one Gaussian process.

Neighbouring lines measure nearly the same eddies, so that the scatter of the velocities about a
uniform wind says less about its error than that of independent numbers. Here the wind is a mean and
von Karman's turbulence; estimated is its average along the path from line to line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.retrieval.ground_winds.turbulence_covariance import of_average, of_lines, with_average

LENGTHS = (50.0, 200.0, 800.0)
"""Length scales of turbulence that are considered, m: those of the boundary layer.

Few lines do not determine the length, which causes half of the error's uncertainty: the prior of
all is equal. Turbulence smaller than the distance of the lines acts as noise.
"""

NOISE_FRACTIONS = (0.003, 0.03, 0.2, 0.6, 0.97)
"""Fractions of the variance of a line that are independent of all others."""

STEPS = 4
"""Places of the average between two lines."""

_MOST_PLACES = 200


@dataclass(frozen=True, eq=False)
class Level:
    """Lines at one height; neighbours in direction may be averaged to one number.

    design (n, 3): unit vectors of the lines: east, north, up.
    places (n, 3): of the gates, m, in the frame that moves with the mean wind.
    path (m, 3): places over which the wind is averaged, m.
    starts (k,): first line of each average.
    velocity (k,): averages, away from the lidar, m/s.
    noise (k,): variance of the noise of the averages relative to its mean.
    """

    design: np.ndarray
    places: np.ndarray
    path: np.ndarray
    starts: np.ndarray
    velocity: np.ndarray
    noise: np.ndarray

    def averaged(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the lines as those of the averages (k, ...)."""
        counts = np.diff(np.append(self.starts, len(self.design)))
        sums = np.add.reduceat(values, self.starts, axis=0)
        return sums / counts.reshape(-1, *[1] * (values.ndim - 1))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Posterior of the turbulence that levels share.

    weight (models,): probability of each length and noise fraction.
    variance (models,): of a line's velocity about the mean wind, (m/s)^2, under each.
    dof: degrees of freedom: lines less three for each level.
    """

    weight: np.ndarray
    variance: np.ndarray
    dof: int


def evidence(levels: Sequence[Level], lengths: Sequence[float], noise: float) -> Evidence:
    """Length, noise fraction and variance that levels share, by their restricted likelihood.

    Every level has a mean wind of its own (Patterson & Thompson, Biometrika 58, 545-554, 1971). The
    variance has the prior 1 / variance and is integrated out; its independent part is at least the
    variance of the noise, if that is known.

    levels: of more than two degrees of freedom in all.
    lengths: m, equally likely.
    noise: mean variance of the stated noise, (m/s)^2; 0: unknown.
    """
    places = np.concatenate([level.places for level in levels])
    design = np.concatenate([level.design for level in levels])
    velocity = np.concatenate([level.velocity for level in levels])
    independent = np.diag(np.concatenate([level.noise for level in levels]))
    means = scipy.linalg.block_diag(*[level.averaged(level.design) for level in levels])
    first = np.cumsum([0, *(len(level.design) for level in levels[:-1])])
    together = Level(
        design,
        places,
        places,
        np.concatenate([level.starts + k for level, k in zip(levels, first, strict=True)]),
        velocity,
        independent,
    )
    dof = len(velocity) - means.shape[1]
    likelihood, variance = [], []
    for length in lengths:
        turbulent = _turbulent(together, length)
        for fraction in NOISE_FRACTIONS:
            factor = np.linalg.cholesky((1 - fraction) * turbulent + fraction * independent)
            white = scipy.linalg.solve_triangular(
                factor, np.column_stack([means, velocity]), lower=True
            )
            basis, triangle = np.linalg.qr(white[:, :-1])
            residual = white[:, -1] - basis @ (basis.T @ white[:, -1])
            # velocities are rounded: no fit is better than 1 mm/s
            square = max(float(residual @ residual), 1e-6 * dof)
            fit = -np.log(np.diag(factor)).sum() - np.log(np.abs(np.diag(triangle))).sum()
            fit -= dof / 2 * np.log(square)
            # the variance is inverse gamma; above a limit, its incomplete integrals
            bound = square * fraction / (2 * noise) if noise > 0 else np.inf
            part = scipy.special.gammainc(dof / 2, bound)
            likelihood.append(fit + np.log(max(part, 1e-300)))
            truncated = scipy.special.gammainc(dof / 2 - 1, bound) / max(part, 1e-300)
            least = noise / fraction
            variance.append(max(square / (dof - 2) * truncated, least))
    weight = np.exp(np.array(likelihood) - max(likelihood))
    return Evidence(weight / weight.sum(), np.array(variance), dof)


def mean_wind(
    level: Level, shared: Evidence, lengths: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Average wind over the path of a level (3,), m/s, and its covariance (3, 3).

    Both are by universal kriging under each model (Cressie, Statistics for Spatial Data, 1993,
    section 3.4); the spread of the models is part of the error.
    """
    path = level.path[:: math.ceil(len(level.path) / _MOST_PLACES)]
    means = level.averaged(level.design)
    winds, errors = [], []
    for length in lengths:
        covariance = _turbulent(level, length)
        cross = level.averaged(with_average(path, level.places, level.design, length))
        average = of_average(path, length)
        for fraction in NOISE_FRACTIONS:
            turbulent = 1 - fraction
            factor = np.linalg.cholesky(turbulent * covariance + fraction * np.diag(level.noise))
            white = scipy.linalg.solve_triangular(
                factor, np.column_stack([means, level.velocity, turbulent * cross]), lower=True
            )
            design, velocity, target = white[:, :3], white[:, 3], white[:, 4:]
            inverse = np.linalg.inv(design.T @ design)
            mean = inverse @ design.T @ velocity
            gap = np.eye(3) - target.T @ design
            winds.append(mean + target.T @ (velocity - design @ mean))
            errors.append(turbulent * average - target.T @ target + gap @ inverse @ gap.T)
    wind = shared.weight @ np.array(winds)
    deviation = np.array(winds) - wind
    within = np.einsum("m,m,mab->ab", shared.weight, shared.variance, np.array(errors))
    return wind, within + np.einsum("m,ma,mb->ab", shared.weight, deviation, deviation)


def _turbulent(level: Level, length: float) -> np.ndarray:
    """Covariance of a level's averages by turbulence alone, of unit variance a component."""
    full = of_lines(level.places, level.design, length)
    return level.averaged(level.averaged(full).T)


def along(places: np.ndarray, steps: int = STEPS) -> np.ndarray:
    """Places (m, 3) along the path from line to line."""
    first, last = places[:-1, None], places[1:, None]
    part = ((np.arange(steps) + 0.5) / steps)[:, None]
    return (first + part * (last - first)).reshape(-1, 3)
