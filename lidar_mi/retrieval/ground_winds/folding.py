"""Radial velocities that fold: known up to a multiple of twice the Nyquist velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

_FASTEST = 80.0  # m/s: of the winds that are searched
_LINES = 8  # of a level that tells folding from outliers
_ROUNDS = 8
_FALSE = 1e-6  # probability that outliers cluster at the multiples
# m/s, of an unknown Nyquist velocity: the spectrum of a pulse of 200 ns at 1.5 um is 1.7 m/s wide
_LEAST_INTERVAL = 4.0
_WIND = 15.0  # m/s: spread of a component of the wind before the scan


@dataclass(frozen=True, eq=False)
class Unfolded:
    """A scan without folds.

    velocity (n,): m/s.
    interval, variance: twice the Nyquist velocity, m/s, and the variance of its error; 0 where it
        is stated.
    folds (n,): how many intervals were added.
    """

    velocity: np.ndarray
    interval: float
    variance: float
    folds: np.ndarray

    def wind_error(self, index: np.ndarray, design: np.ndarray) -> np.ndarray:
        """Covariance (3, 3) of the wind of some cells by the error of the interval."""
        shift, *_ = np.linalg.lstsq(design, self.folds[index], rcond=None)
        return self.variance * np.outer(shift, shift)


def unfolded(
    members: Sequence[np.ndarray], design: np.ndarray, velocity: np.ndarray, nyquist: float | None
) -> Unfolded | None:
    """Velocities of a scan without folds; None: nothing shows that they fold.

    Each level has the wind of the largest mean of cos(2 pi (v - d.m) / interval), the likelihood of
    folded velocities (von Mises), refined by least squares; of an unknown Nyquist velocity together
    with the interval, which begins as the range of all velocities. They fold if residuals of the
    cells beyond half an interval cluster at its multiples: among m uniform ones the count within 5
    standard deviations s is binomial with p = 10 s / interval; false alarms 1e-6 a scan.
    ``members`` are the cells of each level, the ``design`` (n, 3) unit vectors; velocities are in
    m/s.
    """
    interval = 2 * nyquist if nyquist else float(np.ptp(velocity)) if velocity.size else 0.0
    if not interval > (0 if nyquist else _LEAST_INTERVAL):
        return None
    levels = [index for index in members if _directions(design[index]) >= _LINES]
    levels = [index for index in levels if _suspicious(design[index], velocity[index], interval)]
    if not levels:
        return None
    folds = np.zeros(len(velocity))
    for index in levels:
        wind = _likeliest(design[index], velocity[index], interval)
        folds[index] = np.round((design[index] @ wind - velocity[index]) / interval)
    residual, size, variance = np.zeros(len(velocity)), interval / 40, 0.0
    every = np.concatenate(levels)
    for _ in range(_ROUNDS):
        if nyquist is None:
            near = np.abs(residual) < 5 * size
            pairs = [_without_wind(design[i], velocity[i], folds[i], near[i]) for i in levels]
            speed, number = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
            square = float(number @ number)
            if not square > 0:
                return None
            interval = float(-(number @ speed) / square)
            misfit = speed + interval * number
            variance = float(misfit @ misfit) / max(misfit.size - 3 * len(levels) - 1, 1) / square
            if not interval > 0:
                return None
        for index in levels:
            d, v = design[index], velocity[index]
            near = np.abs(residual[index]) < 5 * size
            wind, *_ = np.linalg.lstsq(d[near], (v + folds[index] * interval)[near], rcond=None)
            folds[index] = np.round((d @ wind - v) / interval)
            residual[index] = v + folds[index] * interval - d @ wind
        size = max(1.4826 * float(np.median(np.abs(residual[every]))), 1e-3 * interval)
    far = every[folds[every] != 0]
    chance = 10 * size / interval
    count = int((np.abs(residual[far]) < 5 * size).sum())
    if not (chance < 0.5 and scipy.stats.binom.sf(count - 1, far.size, chance) < _FALSE):
        return None
    return Unfolded(velocity + folds * interval, interval, variance, folds)


def _directions(design: np.ndarray) -> int:
    return len(np.unique(np.round(design, 2), axis=0))


def _suspicious(design: np.ndarray, velocity: np.ndarray, interval: float) -> bool:
    """Whether a wind leaves residuals as large as folds do."""
    wind, *_ = np.linalg.lstsq(design, velocity, rcond=None)
    return bool(np.abs(velocity - design @ wind).max() > interval / 8)


def _likeliest(design: np.ndarray, velocity: np.ndarray, interval: float) -> np.ndarray:
    """Likeliest horizontal wind of a grid with steps of an eighth of the interval."""
    slant = float(np.hypot(design[:, 0], design[:, 1]).max())
    step = interval / (8 * max(slant, 1e-3))
    side = step * np.arange(-np.ceil(_FASTEST / step), np.ceil(_FASTEST / step) + 1)
    winds = np.stack([*map(np.ravel, np.meshgrid(side, side)), np.zeros(side.size**2)])
    winds = winds[:, np.hypot(winds[0], winds[1]) <= _FASTEST + step]
    phase = 2 * np.pi / interval * (velocity[:, None] - design @ winds)
    return winds[:, int(np.cos(phase).mean(0).argmax())]


def _without_wind(
    design: np.ndarray, velocity: np.ndarray, folds: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of velocities and folds about a wind (Frisch and Waugh 1933)."""
    observed = np.column_stack([velocity, folds])[near]
    basis, _ = np.linalg.qr(design[near])
    unexplained = observed - basis @ (basis.T @ observed)
    return unexplained[:, 0], unexplained[:, 1]


def ambiguous(design: np.ndarray, wind: np.ndarray, nyquist: float | None) -> bool:
    """Whether few lines measure the same velocities, folded, in another wind that is as likely.

    For normal winds of 15 m/s a component, the other wind has at least a tenth of the probability.
    """
    if nyquist is None or _directions(design) >= _LINES:
        return False
    slant = np.hypot(design[:, 0], design[:, 1])
    inclined = design[slant > 0.1 * slant.max()]
    # opposite lines fold by opposite numbers: one line is enough
    alias = 2 * nyquist * inclined[:, :2] / (slant[slant > 0.1 * slant.max()] ** 2)[:, None]
    others = np.concatenate([wind[:2] + alias, wind[:2] - alias])
    same = (2 * nyquist) * np.round((others - wind[:2]) @ design[:, :2].T / (2 * nyquist))
    exact = np.abs((others - wind[:2]) @ design[:, :2].T - same).max(1) < 0.05 * nyquist
    more = (others**2).sum(1) - (wind[:2] ** 2).sum()
    return bool((exact & (more < 2 * _WIND**2 * np.log(10))).any())
