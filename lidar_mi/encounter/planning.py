"""Deflections planned over the next seconds within their limits: least squares with bounds."""

import numpy as np
from scipy.optimize import nnls

HORIZON, KNOTS = 2.0, 16
"""Time for which controls are planned (s), and intervals of it."""

INTERVAL = HORIZON / KNOTS


def travel(now: float, largest: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deflections that a control can have in the intervals: those d for which allowed d >= least.

    Parameters
    ----------
    now : float
        Deflection now, rad.
    largest, reach : ndarray, shape (`KNOTS`,)
        Largest deflection in each interval and change from the one before, rad.

    Returns
    -------
    allowed : ndarray, shape (4 `KNOTS`, `KNOTS`)
    least : ndarray, shape (4 `KNOTS`,)
    """
    # where limits narrow faster than the control returns, it returns as fast as it can
    largest = np.maximum(largest, abs(now) - np.cumsum(reach))
    turns = np.eye(KNOTS) - np.eye(KNOTS, k=-1)
    first = now * np.eye(KNOTS)[0]
    allowed = np.concatenate([np.eye(KNOTS), -np.eye(KNOTS), turns, -turns])
    return allowed, np.concatenate([-largest, -largest, first - reach, -first - reach])


def least_squares(
    matrix: np.ndarray, target: np.ndarray, allowed: np.ndarray, least: np.ndarray
) -> np.ndarray:
    """The x that minimises |matrix x - target| where allowed x >= least.

    As a least distance problem, solved by non-negative least squares (Lawson and Hanson 1995,
    chapter 23). The matrix has full rank, and some x is allowed.
    """
    q, r = np.linalg.qr(matrix)
    inverse, free = np.linalg.inv(r), q.T @ target
    distance = allowed @ inverse
    dual = np.vstack([distance.T, least - distance @ free])
    goal = np.zeros(len(dual))
    goal[-1] = 1.0
    weights, _ = nnls(dual, goal)
    residual = dual @ weights - goal
    return inverse @ (free - residual[:-1] / residual[-1])
