"""Statistics of the wind along x, weighted by the evidence of the lines of sight."""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy

from lidar_mi.errors import InputError
from lidar_mi.retrieval.combined.crossflow import Crossflow
from lidar_mi.retrieval.combined.grid_lines import GridLines, covariances_of_lines

# Values of u's standard deviation, m/s, and number of lengths that the evidence is averaged over.
_STDS = np.geomspace(0.05, 10, 16)
_LENGTHS = 8

# Powers of the cross-flow's shear that u's standard deviation may be proportional to.
_POWERS = (0.0, 0.5, 1.0)

# Exponents of u's correlation: of turbulence, and of a smooth field.
_EXPONENTS = (1.0, 2.0)

# Number of statistics drawn, in proportion to their probability.
_DRAWN = 16


class Statistics(NamedTuple):
    """One set of statistics of u.

    ``probability`` is its fraction of the evidence, ``white`` the inverse of the Cholesky factor of
    the covariance S of the lines' velocities, ``misfit`` their mean squared normalised residual.
    """

    std: float
    length: float
    power: float
    exponent: float
    probability: float
    white: np.ndarray
    misfit: float


def correlation(axis: np.ndarray, length: float, exponent: float) -> np.ndarray:
    """exp(-(distance / length)^exponent) of the nodes of an axis, (n, n)."""
    return np.exp(-((abs(axis[:, None] - axis) / length) ** exponent))


def relative_std(
    field: Crossflow,
    lines: GridLines,
    z: np.ndarray,
    y: np.ndarray,
    spacing: float,
    power: float | None,
) -> dict[float, np.ndarray]:
    """Standard deviation of u at the nodes in units of u_std, (z, y), by the power of the shear."""
    if power is not None and not power >= 0:
        raise InputError(f"u_power: {power} is not allowed; expected >= 0")
    square, known = np.zeros(field.valid.shape), np.zeros(field.valid.shape)
    for axis, nodes in enumerate((z, y)):
        step = np.diff(nodes).mean()
        neighbours = np.roll(field.valid, 1, axis) & np.roll(field.valid, -1, axis)
        edge = np.arange(len(nodes))[[0, -1]]
        neighbours[(slice(None),) * axis + (edge,)] = False
        change = np.roll(field.value, -1, axis) - np.roll(field.value, 1, axis)
        square += np.where(neighbours, ((change / (2 * step)) ** 2).sum(-1), 0)
        known += neighbours
    # over the lines' spacing: finer variations of u are not observed
    width = [spacing / np.diff(nodes).mean() for nodes in (z, y)]
    square, known = (
        scipy.ndimage.gaussian_filter(a, width, mode="constant") for a in (square, known)
    )
    uniform = np.ones_like(square)
    known_here = known > 1e-3
    if not (square[known_here] > 0).any():
        return {0.0: uniform} if power is None else {power: uniform}
    shear = np.sqrt(square / np.where(known_here, known, 1))
    shear = np.where(known_here, shear, shear[known_here].mean())
    # u may vary where v and w are uniform
    shear = np.maximum(shear, 1e-3 * shear.max())
    relative_stds = {}
    for exponent in _POWERS if power is None else (power,):
        relative = shear**exponent
        relative_stds[exponent] = relative / np.sqrt(
            (relative[lines.z, lines.y] ** 2 * lines.weight).sum(1).mean()
        )
    return relative_stds


def probable_statistics(
    fixed: np.ndarray,
    residual: np.ndarray,
    lines: GridLines,
    z: np.ndarray,
    y: np.ndarray,
    spacing: float,
    relative_stds: Mapping[float, np.ndarray],
    known: tuple[float | None, float | None, float | None],
) -> tuple[list[Statistics], Statistics]:
    """Statistics of u drawn by their probability, and those of largest evidence.

    The prior is uniform in the standard deviation, which does not favour small ones where lines are
    too noisy to determine it (Gelman 2006, Bayesian Analysis 1, 515-533), and uniform in the
    logarithm of the length. The evidence is the likelihood of the lines' velocities. Statistics
    are drawn at equal steps of the cumulative probability, so that each has the same weight. Those
    of standard deviation, length and exponent that are ``known`` are not estimated.
    """
    std, length, exponent = known
    for name, value, unit in (("u_std", std, "m/s"), ("u_length", length, "m")):
        if value is not None and not value > 0:
            raise InputError(f"{name}: {value} {unit} is not allowed; expected more than 0 {unit}")
    if exponent is not None and not 0 < exponent <= 2:
        raise InputError(f"u_exponent: {exponent} is not allowed; expected more than 0, up to 2")
    stds = _STDS if std is None else np.array([float(std)])
    extent = spacing * np.sqrt(len(residual))
    lengths = np.geomspace(spacing / 4, 2 * extent, _LENGTHS) if length is None else [length]
    exponents = _EXPONENTS if exponent is None else (float(exponent),)
    weight = np.stack([lines.forward * s[lines.z, lines.y] for s in relative_stds.values()], -1)
    pairs = list(itertools.product(exponents, lengths))
    correlations = [(correlation(z, size, a), correlation(y, size, a)) for a, size in pairs]
    shapes = np.concatenate(list(covariances_of_lines(lines, weight, correlations)))
    evidence, square = evidence_of(fixed, residual, shapes, stds)
    # steps of the standard deviation grow with it
    probability = np.exp(evidence - evidence.max()) * stds
    probability /= probability.sum()
    steps = (np.arange(_DRAWN) + 0.5) / _DRAWN
    drawn = np.searchsorted(np.cumsum(probability), steps).clip(max=probability.size - 1)
    drawn, times = np.unique([*drawn, np.argmax(evidence)], return_counts=True)
    of_shape, of_std = np.unravel_index(drawn, evidence.shape)
    variance = stds[of_std, None, None] ** 2
    white = np.linalg.inv(np.linalg.cholesky(fixed + variance * shapes[of_shape]))
    kinds = list(itertools.product(pairs, relative_stds))
    # the best was appended, not drawn
    best = int(np.searchsorted(drawn, np.argmax(evidence)))
    times[best] -= 1
    choices = []
    for k, s, often, whitening in zip(of_shape, of_std, times, white, strict=True):
        (a, size), power = kinds[k]
        misfit = float(square[k, s]) / len(residual)
        probability_of = float(often) / _DRAWN
        choices.append(
            Statistics(
                float(stds[s]), float(size), float(power), a, probability_of, whitening, misfit
            )
        )
    return [choice for choice in choices if choice.probability], choices[best]


def evidence_of(
    fixed: np.ndarray, residual: np.ndarray, shapes: np.ndarray, stds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Evidence of standard deviations of u for several shapes of its covariance.

    After whitening by ``fixed``, one rotation makes S = fixed + std^2 shape tridiagonal for all
    standard deviations. ``fixed`` (lines, lines) is the covariance of the lines' velocities without
    u's, positive definite; ``residual`` (lines,) are observed less expected velocities.

    Returns
    -------
    evidence, square : array (shapes, stds)
        Logarithm of the normal density of the residual, but for a constant of ``fixed``; and
        residual^T S^-1 residual.
    """
    white = np.linalg.inv(np.linalg.cholesky(fixed))
    data = np.tile(white @ residual, (len(shapes), 1))
    middle, side, data = _tridiagonal(white @ shapes @ white.T, data)
    # factors L D L^T of 1 + std^2 T, one line after the other, of all shapes and deviations
    variance = stds**2
    pivot, reduced = 1 + variance * middle[:, :1], data[:, :1] + 0 * variance
    logarithm, square = np.log(pivot), reduced**2 / pivot
    for k in range(1, len(residual)):
        below = variance * side[:, k - 1 : k]
        reduced = data[:, k : k + 1] - below / pivot * reduced
        pivot = 1 + variance * middle[:, k : k + 1] - below**2 / pivot
        logarithm += np.log(pivot)
        square += reduced**2 / pivot
    return -logarithm / 2 - square / 2, square


def _tridiagonal(
    matrices: np.ndarray, vectors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Diagonals T of symmetric matrices A = Q T Q^T, by Householder's reflections, and Q^T vectors.

    For matrices (number, n, n) and vectors (number, n): the diagonal, the off-diagonal, and Q^T
    vectors. It takes a third of the time of eigenvectors, which the evidence does not need.
    """
    if matrices.shape[1] == 1:
        return matrices[:, 0], matrices[:, 0, :0], vectors
    parts = [scipy.linalg.lapack.dsytrd(matrix, lower=1) for matrix in matrices]
    reflectors, middle, side, scale = (np.stack([part[k] for part in parts]) for k in range(4))
    turned = vectors.copy()
    for k in range(matrices.shape[1] - 1):
        across = reflectors[:, k + 1 :, k].copy()
        across[:, 0] = 1
        part = turned[:, k + 1 :]
        part -= (scale[:, k] * (across * part).sum(1))[:, None] * across
    return middle, side, turned
