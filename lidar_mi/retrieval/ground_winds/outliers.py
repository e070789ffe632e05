"""Radial velocities that disagree with the wind of the other lines."""

from itertools import combinations

import numpy as np

LIMIT = 5.0
"""Residual of an outlier over the standard deviation of the lines.

Residuals by turbulence are neither normal nor independent, and the spread of few lines is known to
a third: a lower limit would reject air. Velocities without a signal are uniform within tens of m/s.
"""

_SUBSETS = 200
_NORMAL = 1.4826  # standard deviation over the median of the absolute values, of a normal number


def residuals(design: np.ndarray, velocity: np.ndarray, seed: int = 0) -> np.ndarray:
    """Residuals (n,) of the wind of three lines that has the least median of them (n >= 4).

    Least median of squares (Rousseeuw, J. Am. Stat. Assoc. 79, 871-880, 1984), over all subsets of
    three lines or 200 random ones: half of the lines may be outliers. The ``design`` (n, 3) are
    unit vectors, the ``velocity`` (n,) is in m/s.
    """
    count = len(velocity)
    if count <= 11:
        subsets = np.array(list(combinations(range(count), 3)))
    else:
        random = np.random.default_rng(seed)
        subsets = np.argsort(random.random((_SUBSETS, count)), axis=1)[:, :3]
    matrices = design[subsets]
    determined = np.abs(np.linalg.det(matrices)) > 1e-3 * np.abs(np.linalg.det(matrices)).max()
    matrices, subsets = matrices[determined], subsets[determined]
    if not len(subsets):
        return np.zeros(count)
    winds = np.linalg.solve(matrices, velocity[subsets][..., None])[..., 0]
    residual = velocity - winds @ design.T
    # of n numbers of which three fit exactly, the middle of the others
    middle = np.sort(np.abs(residual), axis=1)[:, (count + 3) // 2]
    return residual[int(np.argmin(middle))]


def refitted(
    design: np.ndarray, velocity: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) of the least-squares wind of the kept lines, and their expected size (n,).

    In standard deviations of a line: below 1 for those that were fitted, above for the others.
    """
    basis = design[keep]
    inverse = np.linalg.pinv(basis.T @ basis)
    wind = inverse @ basis.T @ velocity[keep]
    leverage = np.einsum("ia,ab,ib->i", design, inverse, design)
    return velocity - design @ wind, np.sqrt(np.maximum(1 - np.where(keep, 1, -1) * leverage, 1e-3))


def spread(residual: np.ndarray) -> float:
    """Standard deviation of residuals of several levels, robust: one may be nothing but noise."""
    return float(_NORMAL * np.median(np.abs(residual)))


def spread_of_best(residual: np.ndarray, count: np.ndarray) -> float:
    """Standard deviation of the lines by `residuals` of levels of so many lines.

    Three residuals of a level are 0, and the others are the smallest of any three lines: they are
    multiplied by 1 + 5 / (n - 3) (Rousseeuw & Leroy 1987, Robust Regression and Outlier Detection,
    chapter 5).
    """
    others = np.abs(residual) > 1e-9
    return spread(residual[others] * (1 + 5 / (count[others] - 3))) if others.any() else 0.0
