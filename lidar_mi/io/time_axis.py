"""Times of a file's states: their unit, the state of a time, the times as they are listed."""

import re

import numpy as np

from lidar_mi.errors import InputError

_SINCE = re.compile(r"\s*(\S+)\s+(?:since|after|from|ref)\s+(?=\S*\d).*", re.IGNORECASE | re.DOTALL)
# The states need not be evenly spaced.
_CALENDAR = re.compile(r"(common_|leap_|julian_|tropical_|gregorian_)?(months?|years?|yrs?)", re.I)

# Tolerance of a state's time as a fraction of the interval to its neighbour; velocities from two
# states have twice this relative error.
_TOLERANCE = 1e-3
# For axes in single precision, their rounding, up to this fraction.
_LARGEST_ROUNDING = 1e-2
# In seconds: the fastest air of a wake, 50 m/s, moves by 5 cm.
_LARGEST_TOLERANCE = 1e-3


def count_unit(text: str, where: str) -> str:
    """The unit in which a time counts: of "seconds since 1970-01-01", seconds.

    The date and the calendar do not matter to a count of seconds, minutes, hours or days, which all
    calendars have of one length. ``where`` names file and variable, for the message.

    Raises InputError: months or years, whose length depends on the date.
    """
    match = _SINCE.fullmatch(str(text))
    unit = match[1] if match else str(text).strip()
    if _CALENDAR.fullmatch(unit):
        raise InputError(
            f"{where} has the unit {str(text)!r}, of no fixed length; allowed: s or a unit that "
            "converts to it"
        )
    # units of time are written in any case (UDUNITS, cftime); one letter may be a prefix
    return unit.lower() if match and len(unit) > 1 else unit


def tolerances(times: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Tolerance of each time, s, whatever the origin of the axis.

    1e-3 of the interval to the nearest other time or, up to 1e-2 of it, the rounding of the axis;
    at most 1 ms.
    """
    order = np.argsort(times)
    steps = np.diff(times[order])
    gaps = np.full(times.size, np.inf)
    gaps[order] = np.fmin(np.append(steps, np.inf), np.append(np.inf, steps))
    fraction = np.maximum(_TOLERANCE * gaps, np.minimum(rounding, _LARGEST_ROUNDING * gaps))
    # text that is read and units that are converted differ by the last bits of double precision
    return np.minimum(fraction, _LARGEST_TOLERANCE) + 2 * np.spacing(np.abs(times))


def listing(times: np.ndarray, tolerance: np.ndarray, most: int = 20) -> str:
    """Times as their shortest numbers within the tolerance: "40, 40.1 ..."."""
    numbers = [_shortest(float(t), float(d)) for t, d in zip(times[:most], tolerance, strict=False)]
    return ", ".join(numbers) + (" ..." if times.size > most else "")


def _shortest(time: float, tolerance: float) -> str:
    texts = (f"{time:.{digits}f}" for digits in range(18))
    fitting = (text for text in texts if abs(float(text) - time) <= tolerance)
    return next(fitting, repr(time))


def state_at(time: float, times: np.ndarray, rounding: np.ndarray, where: str) -> int:
    """Index of the state of a time.

    time: s.
    times, rounding (n,): of the states, and to which they are rounded in the file, s.
    where: file, for the message.

    Raises InputError: no state, or more than one, has this time.
    """
    tolerance = tolerances(times, rounding)
    fits = np.flatnonzero(np.abs(times - time) <= tolerance)
    if fits.size == 1:
        return int(fits[0])
    text = _shortest(time, 2 * float(np.spacing(abs(time))))
    allowed = f"allowed: {listing(times, tolerance)} s"
    if fits.size:
        raise InputError(f"{where}: {fits.size} states have the time {text} s; expected one each")
    raise InputError(f"{where}: time {text} s is not there; {allowed}")
