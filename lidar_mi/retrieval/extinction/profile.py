"""Checks of a range profile."""

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError


def numbers(name: str, values: ArrayLike) -> np.ndarray:
    """Values as an array of numbers.

    Raises
    ------
    InputError
    """
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {values!r} is not allowed; expected numbers") from None


def checked_profile(signal: ArrayLike, ranges: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Signal above 0 at ascending ranges, as numbers.

    Raises
    ------
    InputError
    """
    ranges = numbers("ranges", ranges)
    steps = np.diff(ranges)
    if ranges.ndim != 1 or ranges.size < 2 or not (ranges[0] >= 0 and (steps > 0).all()):
        raise InputError(
            "ranges: not at least two finite, ascending distances from 0 m; expected a profile's"
        )
    signal = along("signal", signal, ranges)
    if not (signal > 0).all():
        raise InputError(
            f"signal: {signal.min():g} is not allowed; expected values above 0 at every range "
            "(end the profile where the signal is noise)"
        )
    return signal, ranges


def along(name: str, values: ArrayLike, ranges: np.ndarray) -> np.ndarray:
    """Finite values at every range, or one value for all.

    Raises
    ------
    InputError
    """
    values = numbers(name, values)
    if values.shape not in ((), ranges.shape) or not np.isfinite(values).all():
        raise InputError(
            f"{name}: shape {values.shape} or values are not allowed; expected finite numbers, "
            f"one at each of {ranges.size} ranges"
        )
    return np.broadcast_to(values, ranges.shape)


def check_index(reference: int, ranges: np.ndarray) -> None:
    """Refuse a reference that is no index of the ranges.

    Raises
    ------
    InputError
    """
    if not -len(ranges) <= reference < len(ranges):
        raise InputError(
            f"reference: {reference} is not allowed; expected an index of {len(ranges)} ranges"
        )


def positive_number(name: str, value: float, unit: str = "") -> float:
    """A finite number above 0.

    Raises
    ------
    InputError
    """
    number = numbers(name, value)
    if not (number.ndim == 0 and np.isfinite(number) and number > 0):
        shown = " ".join([str(value), unit]).strip()
        raise InputError(f"{name}: {shown} is not allowed; expected a number above 0")
    return float(number)
