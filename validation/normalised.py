"""Normalised errors: means over values that are not independent, with their standard errors."""

import numpy as np

BLOCK = 10
"""Vectors along the side of a block: 20 m where every fourth pixel of 0.5 m has one."""


def indicator(score: np.ndarray, limit: float) -> np.ndarray:
    """1 within the limit, 0 beyond it, NaN where there is no score."""
    return np.where(np.isfinite(score), np.abs(score) < limit, np.nan)


def rms(values: np.ndarray) -> float:
    """Of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def mean_over_groups(total: np.ndarray, number: np.ndarray) -> tuple[float, float]:
    """Mean of all values, and its standard error from how independent groups scatter.

    Parameters
    ----------
    total, number : (groups,) arrays
        Sum and number of each group's values.

    Returns
    -------
    (float, float)
        NaN without values; the error is NaN with values in fewer than two groups.
    """
    if number.sum() == 0:
        return np.nan, np.nan
    mean = total.sum() / number.sum()
    groups = (number > 0).sum()
    if groups < 2:
        return float(mean), np.nan
    deviation = total - mean * number
    error = np.sqrt((deviation**2).sum() * groups / (groups - 1)) / number.sum()
    return float(mean), float(error)


def sums_of_blocks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum and number of the finite values in each block of the image, over all images.

    The last block of a row or column has what is left of it.

    Parameters
    ----------
    values : (images, z, y) array
    """
    rows, columns = (np.arange(0, max(n - BLOCK, 0) + 1, BLOCK) for n in values.shape[1:])
    known = np.isfinite(values)

    def sums(of):
        return np.add.reduceat(np.add.reduceat(of.sum(0), rows, axis=0), columns, axis=1).ravel()

    return sums(np.where(known, values, 0.0)), sums(known.astype(float))
