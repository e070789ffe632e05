"""What a file of lines of sight holds, before it becomes the data set: arrays and remarks."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError

FIELDS = {
    "radial_velocity": ("m s-1", "radial velocity, positive away from the lidar"),
    "snr": ("1", "signal-to-noise ratio of the powers (carrier-to-noise ratio)"),
    "spectral_width": ("m s-1", "width of the Doppler spectrum"),
    "attenuated_backscatter": ("m-1 sr-1", "attenuated backscatter coefficient"),
}
"""Quantities of a line and a gate: unit and meaning."""

ANGLES = {
    "azimuth": "azimuth of the line of sight, clockwise from north",
    "elevation": "elevation of the line of sight above the horizon",
    "pitch": "pitch of the platform, as reported: positive with the front up",
    "roll": "roll of the platform, as reported: positive with the right side down",
}
"""Angles of a line, degrees."""

PLACE = {
    "latitude": ("degrees_north", "latitude of the lidar"),
    "longitude": ("degrees_east", "longitude of the lidar"),
    "altitude": ("m", "altitude of the lidar above mean sea level"),
}
"""Place of the lidar: unit and meaning."""


@dataclass(eq=False)
class Scan:
    """Lines of one file or of one of its sweeps.

    time (lines,): UTC.
    angles (dict of str to (lines,) array): `ANGLES`, degrees: azimuth and elevation, the others
        where there are any.
    range (gates,) or (lines, gates) array: of the gates' centres, m.
    fields (dict of str to (lines, gates) array): `FIELDS`; NaN: missing.
    place: `PLACE`.
    rejected (lines, gates): by the lidar's own software.
    about: attributes: kind, instrument, scan_type, gate_length (m), ...
    remarks: what is unusual, a sentence each.
    """

    time: np.ndarray
    angles: dict[str, np.ndarray]
    range: np.ndarray
    fields: dict[str, np.ndarray]
    place: dict[str, float] = field(default_factory=dict)
    rejected: np.ndarray | None = None
    about: dict[str, str | float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def check(scan: Scan, path: Path) -> Scan:
    """A scan with angles in range and ranges in metres; changes become remarks.

    Raises InputError: no line with a time and a direction, ranges that are no numbers, do not
    increase or can only be kilometres.
    """
    lines = len(scan.time)
    complete = ~np.isnat(scan.time)
    for name in ("azimuth", "elevation"):
        complete &= np.isfinite(scan.angles[name])
    if not complete.any():
        raise InputError(
            f"{path}: no line of sight, of {lines}, has a time, an azimuth and an elevation; "
            "expected one or more"
        )
    if not complete.all():
        # as while a scanner moves from one scan to the next
        scan = part(scan, np.flatnonzero(complete))
        scan.remarks.append(
            f"{lines - int(complete.sum())} of {lines} lines have no time or direction"
        )
    _level(scan)
    _wrap(scan)
    _check_ranges(scan.range, path)
    return scan


TABLE = "table (CSV)"
"""Kind of tables."""

LEVEL = 0.02
"""Degrees of pitch and roll below which a platform is level: 3 mm/s of w in wind of 10 m/s."""


def _level(scan: Scan) -> None:
    """Directions of the beam with pitch and roll of the platform, where their axes are known.

    In tables, azimuth and elevation are relative to the platform, whose front is at azimuth 0:
    positive pitch raises it, positive roll lowers the right side. In CfRadial files they are
    relative to the horizon. Other makers do not document the axes of their tilt sensors: their tilt
    is not applied, and retrievals report it.
    """
    kind = str(scan.about.get("kind", ""))
    measured = {"pitch", "roll"} <= set(scan.angles)
    if not measured or kind.startswith("CfRadial") or "tilt" in scan.about:
        return
    pitch, roll = (np.deg2rad(np.nan_to_num(scan.angles[name])) for name in ("pitch", "roll"))
    tilt = float(np.rad2deg(np.hypot(pitch, roll).max()))
    if tilt < LEVEL:
        return
    scan.about["tilt"] = "applied" if kind == TABLE else "not applied"
    if kind != TABLE:
        return
    azimuth, elevation = (np.deg2rad(scan.angles[name]) for name in ("azimuth", "elevation"))
    right, front = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    up = np.sin(elevation)
    # about the front axis, then about the right one
    right, up = right * np.cos(roll) + up * np.sin(roll), up * np.cos(roll) - right * np.sin(roll)
    front, up = (
        front * np.cos(pitch) - up * np.sin(pitch),
        front * np.sin(pitch) + up * np.cos(pitch),
    )
    beyond_zenith = scan.angles["elevation"] > 90
    slope = np.arctan2(up, np.hypot(right, front))
    scan.angles["elevation"] = np.rad2deg(np.where(beyond_zenith, np.pi - slope, slope))
    rotated = np.arctan2(right, front) + np.where(beyond_zenith, np.pi, 0.0)
    scan.angles["azimuth"] = np.rad2deg(rotated)
    scan.remarks.append(
        f"pitch and roll of up to {tilt:.2f} degrees are applied, with the front of the "
        "platform at azimuth 0"
    )


def part(scan: Scan, lines: slice | np.ndarray) -> Scan:
    """Some of the lines of a scan."""
    return Scan(
        scan.time[lines],
        {name: values[lines] for name, values in scan.angles.items()},
        scan.range[lines] if scan.range.ndim == 2 else scan.range,
        {name: values[lines] for name, values in scan.fields.items()},
        scan.place,
        None if scan.rejected is None else scan.rejected[lines],
        scan.about,
        scan.remarks,
    )


def _wrap(scan: Scan) -> None:
    """Azimuths to 0 to 360, elevations to -180 to 180 degrees; no remark on 360 itself."""
    azimuth, elevation = scan.angles["azimuth"], scan.angles["elevation"]
    for name, values, low, high in (
        ("azimuth", azimuth, -180.0, 360.0),
        ("elevation", elevation, -90.0, 180.1),
    ):
        beyond = (values < low) | (values > high)
        if beyond.any():
            scan.remarks.append(
                f"{name}: {values[beyond][0]:g} degrees and more beyond {low:g} to {high:.0f} in "
                f"{int(beyond.sum())} lines; full turns were taken off"
            )
    scan.angles["azimuth"] = np.mod(azimuth, 360.0)
    beyond = (elevation < -90.0) | (elevation > 180.1)
    scan.angles["elevation"] = np.where(beyond, (elevation + 180.0) % 360.0 - 180.0, elevation)


def _check_ranges(ranges: np.ndarray, path: Path) -> None:
    finite = ranges[np.isfinite(ranges)]
    if not finite.size:
        raise InputError(f"{path}: range: no finite number; expected metres")
    steps = np.diff(ranges, axis=-1)
    if (steps[np.isfinite(steps)] <= 0).any():
        raise InputError(f"{path}: range: does not increase from gate to gate; expected metres")
    # a pulse alone is longer
    if finite.max() < 40:
        raise InputError(
            f"{path}: range: up to {finite.max():g} m, shorter than a pulse; expected metres, or "
            "the unit of kilometres (units: km, in a table range [km])"
        )


def seconds(values: np.ndarray, origin: np.datetime64) -> np.ndarray:
    """Times from seconds after an origin, datetime64[ns]; NaT where they are not finite."""
    finite = np.isfinite(values)
    counts = np.where(finite, np.round(np.where(finite, values, 0) * 1e9), 0).astype("int64")
    times = origin.astype("datetime64[ns]") + counts.astype("timedelta64[ns]")
    return np.where(finite, times, np.datetime64("NaT"))


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names in a message."""
    return ", ".join(names[:most]) + (" ..." if len(names) > most else "") or "none"


_SHORTEST_LINE = 1e-3  # s: tens of pulses
_FIRST_SCAN = np.datetime64("1980-01-01", "s")
_ENCODINGS = (
    ("milliseconds since 1970", 1e-3, 0.0),
    ("microseconds since 1970", 1e-6, 0.0),
    ("nanoseconds since 1970", 1e-9, 0.0),
    ("days since 1970", 86400.0, 0.0),
    ("days of MATLAB (datenum)", 86400.0, 719529.0),
    ("days of spreadsheets (since 1899-12-30)", 86400.0, 25569.0),
    ("Julian days", 86400.0, 2440587.5),
    ("seconds since 1904 (LabVIEW)", 1.0, 2082844800.0),
)
"""Encodings other than seconds since 1970: name, seconds of a unit, number of 1970-01-01."""


def dated(values: np.ndarray, name: str, path: Path) -> tuple[np.ndarray, list[str]]:
    """Times of numbers without a unit, and a remark if they are no seconds since 1970.

    They count from 1970, unless they then lie in the future or closer together than lines can: then
    the only other common encoding with dates from 1980 to today is used.

    Raises InputError: no encoding, or more than one, is possible.
    """
    epoch = np.datetime64("1970-01-01", "s")
    finite = values[np.isfinite(values)]
    step = float(np.median(np.diff(np.unique(finite)))) if np.unique(finite).size > 1 else np.inf
    first, last = (
        float((date - epoch) / np.timedelta64(1, "s"))
        for date in (_FIRST_SCAN, np.datetime64("now") + np.timedelta64(1, "D"))
    )

    def possible(unit: float, zero: float, first: float) -> bool:
        since = unit * (finite - zero)
        return bool(((since >= first) & (since <= last)).all()) and unit * step >= _SHORTEST_LINE

    # seconds may also count from the start of the measurement
    if not finite.size or possible(1.0, 0.0, -86400.0):
        return seconds(values, epoch), []
    encodings = [date for date in _ENCODINGS if possible(date[1], date[2], first)]
    if len(encodings) != 1:
        raise InputError(
            f"{path}: {name}: {finite[0]:.10g} without a unit is not allowed; expected seconds "
            "since 1970, ISO 8601, or a unit"
        )
    text, unit, zero = encodings[0]
    remark = f"{name}: {finite[0]:.10g} is no time in seconds since 1970: read as {text}"
    return seconds(unit * (values - zero), epoch), [remark]


_TOWARD = r"(?:toward|approach|inbound|incoming)"
_AWAY = r"(?:away|reced|outbound|outgoing|outward)"
_SIGN = r"(?:positive|negative|(?<!\w)[+-]ve|(?<!\w)[><]\s*0)"
_SIGN_CONVENTION = re.compile(
    rf"(?P<sign>{_SIGN})[^.;,]*?(?P<way>{_TOWARD}|{_AWAY})"
    rf"|(?P<way2>{_TOWARD}|{_AWAY})[^.;,]*?(?P<sign2>{_SIGN})",
    re.IGNORECASE,
)


def toward_in_words(text: str) -> bool | None:
    """Whether words say that a positive velocity is toward the lidar; None: nothing, or both.

    >>> toward_in_words("Doppler velocity, positive towards the lidar")
    True
    """
    senses = set()
    for match in _SIGN_CONVENTION.finditer(text):
        sign, way = match["sign"] or match["sign2"], match["way"] or match["way2"]
        positive = sign.lower().startswith(("positive", "+", ">"))
        senses.add((re.match(_TOWARD, way, re.IGNORECASE) is not None) == positive)
    return senses.pop() if len(senses) == 1 else None


_FILL = -100.0  # dB: below it a value stands for none


def ratio_of_powers(values: np.ndarray, unit: str, name: str) -> tuple[np.ndarray, list[str]]:
    """A ratio of powers from dB, from SNR + 1 (intensity) or as it is, and remarks.

    Without a unit it is in dB if more than 1 % of the values are below -1: total power is positive.
    """
    unit = unit.strip().lower()
    if unit.startswith(("db", "decibel")):
        return 10.0 ** (values / 10), []
    if unit in ("", "unitless", "none", "1"):
        finite = values[np.isfinite(values) & (values > _FILL)]
        if finite.size and np.mean(finite < -1.0) > 0.01:
            return 10.0 ** (values / 10), [
                f"{name} has values below -1, which no ratio of powers has: read as dB"
            ]
    return (values - 1.0 if name.lower() == "intensity" else values), []
