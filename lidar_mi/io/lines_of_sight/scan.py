"""What a file of lines of sight holds, before it becomes the data set: arrays and remarks."""

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
"""Of a line and a gate: unit and meaning."""

ANGLES = {
    "azimuth": "azimuth of the line of sight, clockwise from north",
    "elevation": "elevation of the line of sight above the horizon",
    "pitch": "pitch of the platform, as reported",
    "roll": "roll of the platform, as reported",
}
"""Of a line, degrees."""

PLACE = {
    "latitude": ("degrees_north", "latitude of the lidar"),
    "longitude": ("degrees_east", "longitude of the lidar"),
    "altitude": ("m", "altitude of the lidar above mean sea level"),
}
"""Of the lidar: unit and meaning."""


@dataclass(eq=False)
class Scan:
    """Lines of one file or of one of its sweeps.

    Attributes
    ----------
    time : (lines,) array of datetime64[ns]
        UTC.
    angles : dict of str to (lines,) array
        `ANGLES`, degrees: azimuth and elevation, the others where there are any.
    range : (gates,) or (lines, gates) array
        Of the gates' centres, m.
    fields : dict of str to (lines, gates) array
        `FIELDS`; NaN: missing.
    place : dict of str to float
        `PLACE`.
    rejected : (lines, gates) array of bool, optional
        By the lidar's own software.
    about : dict
        Attributes: kind, instrument, scan_type, gate_length (m), ...
    remarks : list of str
        What is unusual, a sentence each.
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
    """A scan with angles in range and ranges in metres; what was changed is remarked.

    Raises
    ------
    InputError
        No line with a time and a direction, ranges that are no numbers, do not increase or can only
        be kilometres.
    """
    lines = len(scan.time)
    known = ~np.isnat(scan.time)
    for name in ("azimuth", "elevation"):
        known &= np.isfinite(scan.angles[name])
    if not known.any():
        raise InputError(
            f"{path}: no line of sight, of {lines}, has a time, an azimuth and an elevation; "
            "expected one or more"
        )
    if not known.all():
        # as while a scanner moves from one scan to the next
        scan = part(scan, np.flatnonzero(known))
        scan.remarks.append(
            f"{lines - int(known.sum())} of {lines} lines have no time or direction"
        )
    _wrap(scan)
    _check_ranges(scan.range, path)
    return scan


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
    """Azimuths to 0 to 360, elevations to -180 to 180 degrees; 360 itself is not worth a word."""
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
    known = ranges[np.isfinite(ranges)]
    if not known.size:
        raise InputError(f"{path}: range: no finite number; expected metres")
    steps = np.diff(ranges, axis=-1)
    if (steps[np.isfinite(steps)] <= 0).any():
        raise InputError(f"{path}: range: does not increase from gate to gate; expected metres")
    # the light of a pulse alone is longer
    if known.max() < 40:
        raise InputError(
            f"{path}: range: up to {known.max():g} m, shorter than a pulse; expected metres, or "
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
