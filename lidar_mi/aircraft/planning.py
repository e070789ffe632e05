"""Deflections planned over the next seconds within their limits: least squares with bounds."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

HORIZON, KNOTS = 2.0, 16
"""Time for which controls are planned (s), and intervals of it."""

INTERVAL = HORIZON / KNOTS


TRAVEL = np.concatenate(
    [np.eye(KNOTS), -np.eye(KNOTS), *(s * (np.eye(KNOTS) - np.eye(KNOTS, k=-1)) for s in (1, -1))]
)
"""Rows whose products with the deflections of the intervals have the bounds `least_travel`."""


def least_travel(now: float, largest: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """What a control can do: deflections d with `TRAVEL` d >= these, shape (4 `KNOTS`,).

    now: deflection now, rad.
    largest, reach (`KNOTS`,): largest deflection in each interval and change from the one before,
        rad.
    """
    # where limits narrow faster than the control returns, it returns as fast as it can
    largest = np.maximum(largest, abs(now) - np.cumsum(reach))
    first = now * np.eye(KNOTS)[0]
    return np.concatenate([-largest, -largest, first - reach, -first - reach])


def least_squares(
    matrix: np.ndarray, allowed: np.ndarray
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The x that minimises |matrix x - target| where allowed x >= least, of target and least.

    It is a least distance problem, solved by non-negative least squares (Lawson and Hanson 1995,
    chapter 23). The matrix has full rank, and some x is allowed.
    """
    q, r = np.linalg.qr(matrix)
    inverse = np.linalg.inv(r)
    distance = allowed @ inverse

    def solved(target: np.ndarray, least: np.ndarray) -> np.ndarray:
        free = q.T @ target
        dual = np.vstack([distance.T, least - distance @ free])
        goal = np.zeros(len(dual))
        goal[-1] = 1.0
        weights, _ = nnls(dual, goal)
        residual = dual @ weights - goal
        return inverse @ (free - residual[:-1] / residual[-1])

    return solved
