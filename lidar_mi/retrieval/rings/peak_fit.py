"""Positions of peaks: Gaussians on a level or a slope, fitted by Levenberg-Marquardt."""

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.optimize import OptimizeWarning, curve_fit

from lidar_mi.errors import InputError


def peaks(
    x: np.ndarray, values: np.ndarray, starts: Sequence[float], reach: float, slope: bool = False
) -> np.ndarray:
    """Positions of neighbouring peaks of one width, fitted together as they overlap.

    Parameters
    ----------
    x, values : arrays (N,)
        NaN values are left out.
    starts : sequence of float
        Approximate positions of the peaks, ascending.
    reach : float
        The fit goes from the first less ``reach`` to the last plus ``reach``.
    slope : bool
        Whether the background of the peaks may have a slope.

    Returns
    -------
    array, as many as ``starts``

    Raises
    ------
    InputError
        A peak that is not within 0.7 ``reach`` of its start.
    """
    starts = np.asarray(starts, float)
    failed = InputError(
        f"rings: no peak within {reach:.3g} of {starts[0]:.4g}; expected a ring there"
    )
    near = (x >= starts[0] - reach) & (x <= starts[-1] + reach) & np.isfinite(values)
    number = len(starts)
    if near.sum() < 5 + 2 * number:
        raise failed
    x, values = x[near], values[near]
    low, high = values.min(), values.max()

    def gaussians(x, width, level, *rest):
        place, height = np.array(rest[:number]), np.array(rest[number : 2 * number])
        tilt = rest[-1] * (x - starts[0]) / reach if slope else 0.0
        return level + tilt + np.exp(-(((x[:, None] - place) / width) ** 2) / 2) @ height

    guess = (reach / 2, low, *starts, *[high - low] * number, *[0.0] * slope)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", OptimizeWarning)
            found = curve_fit(gaussians, x, values, guess, method="lm", maxfev=3000)[0]
    except (RuntimeError, OptimizeWarning):
        raise failed from None
    places, heights = found[2 : 2 + number], found[2 + number : 2 + 2 * number]
    if not (np.all(np.abs(places - starts) < 0.7 * reach) and np.all(heights > 0)):
        raise failed
    return places


def peak(x: np.ndarray, values: np.ndarray, start: float, reach: float) -> float:
    """Position of the one peak within ``reach`` of ``start``; as `peaks`."""
    return float(peaks(x, values, [start], reach)[0])
