"""Positions of peaks: Gaussians on a level or a slope, fitted by Levenberg-Marquardt."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import leastsq

from lidar_mi.errors import InputError


def peaks(
    x: np.ndarray, values: np.ndarray, starts: Sequence[float], reach: float, slope: bool = False
) -> np.ndarray:
    """Positions of neighbouring peaks of one width, fitted together as they overlap.

    x, values (N,): NaN values are masked.
    starts: approximate positions of the peaks, ascending.
    reach: the fit goes from the first less ``reach`` to the last plus ``reach``.
    slope: whether the background of the peaks may have a slope.

    Raises InputError: a peak that is not within 0.7 ``reach`` of its start.

    Returns
    -------
    array, as many as ``starts``
    """
    first_guess = np.asarray(starts, float)
    failed = InputError(
        f"rings: no peak within {reach:.3g} of {first_guess[0]:.4g}; expected a ring there"
    )
    near = (x >= first_guess[0] - reach) & (x <= first_guess[-1] + reach) & np.isfinite(values)
    number = len(first_guess)
    if near.sum() < 5 + 2 * number:
        raise failed
    x, values = x[near], values[near]
    low, high = values.min(), values.max()
    slopes = np.empty((2 + 2 * number + slope, len(x)))  # of the model, parameter by parameter
    slopes[1] = 1.0
    if slope:
        slopes[-1] = (x - first_guess[0]) / reach
    by_place, bells = slopes[2 : 2 + number], slopes[2 + number : 2 + 2 * number]

    def shapes(parameters: np.ndarray) -> np.ndarray:
        """Distances from the peaks in widths; the Gaussians go to ``bells``."""
        away = (x - parameters[2 : 2 + number, None]) / parameters[0]
        np.exp(-0.5 * away * away, out=bells)
        return away

    def misfit(parameters: np.ndarray) -> np.ndarray:
        shapes(parameters)
        # linear in all but width and places
        return parameters[1] + parameters[2 + number :] @ slopes[2 + number :] - values

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        away = shapes(parameters)
        heights = parameters[2 + number : 2 + 2 * number, None]
        np.multiply(away * bells, heights / parameters[0], out=by_place)
        slopes[0] = (away * by_place).sum(0)
        return slopes

    guess = (reach / 2, low, *first_guess, *[high - low] * number, *[0.0] * slope)
    solution, covariance, *_, end = leastsq(
        misfit, guess, Dfun=jacobian, col_deriv=True, full_output=True, maxfev=3000
    )
    if end not in (1, 2, 3, 4) or covariance is None:
        raise failed
    places, heights = solution[2 : 2 + number], solution[2 + number : 2 + 2 * number]
    if not (np.all(np.abs(places - first_guess) < 0.7 * reach) and np.all(heights > 0)):
        raise failed
    return places


def peak(x: np.ndarray, values: np.ndarray, start: float, reach: float) -> float:
    """Position of the one peak within ``reach`` of ``start``; as `peaks`."""
    return float(peaks(x, values, [start], reach)[0])
