"""Compromises that no other point improves on in everything: the Pareto front."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_mi.errors import InputError


def pareto_front(objectives: ArrayLike, maximised: Sequence[bool] = ()) -> NDArray[np.bool_]:
    """Which points are not dominated.

    A point is dominated by another that is at least as good in every objective and better in one.
    Of equal points all are on the front.

    objectives (point, objective): NaN: the point is not on the front and dominates none.
    maximised: whether larger is better, for each objective; by default smaller is.

    Raises InputError: not one value of ``maximised`` per objective.
    """
    values = np.array(objectives, dtype=float)
    if values.ndim != 2 or (len(maximised) and len(maximised) != values.shape[1]):
        raise InputError(
            f"maximised: {len(maximised)} values are not allowed; expected one per objective of "
            f"{values.shape}"
        )
    if len(maximised):
        values[:, np.asarray(maximised, dtype=bool)] *= -1
    finite = np.flatnonzero(np.isfinite(values).all(axis=1))
    # in this order a point comes after all that dominate it
    order = finite[np.lexsort(values[finite].T[::-1])]
    front = np.zeros(len(values), dtype=bool)
    best = np.empty((0, values.shape[1]))
    for index in order:
        point = values[index]
        no_worse = (best <= point).all(axis=1)
        if not (no_worse & (best < point).any(axis=1)).any():
            front[index] = True
            best = np.vstack([best, point])
    return front
