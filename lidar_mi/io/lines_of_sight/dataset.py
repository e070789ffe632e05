"""The data set of lines of sight: scans one after another on common ranges, with CF attributes."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import LineFlag, flag_attributes
from lidar_mi.io.lines_of_sight.scan import ANGLES, FIELDS, PLACE, Scan
from lidar_mi.variables import variable

_SAME_PLACE = 0.01  # degrees: of one lidar, rounded differently from file to file
_MOST_RANGES = 4  # times the gates of a line: common ranges of lines whose gates differ
_CENTIMETRE = 0.01
_STANDARD = {
    "radial_velocity": "radial_velocity_of_scatterers_away_from_instrument",
    "azimuth": "sensor_to_target_azimuth_angle",
    "elevation": "sensor_to_target_elevation_angle",
    "pitch": "platform_pitch",
    "roll": "platform_roll",
    "latitude": "latitude",
    "longitude": "longitude",
    "altitude": "altitude",
}


def assembled(
    scans: Sequence[tuple[str, Scan, np.ndarray]], thresholds: dict[str, float]
) -> xr.Dataset:
    """One data set of all scans, lines in the order of time.

    Each scan has its file's name and its flags (lines, gates); thresholds become attributes.

    Raises InputError: lidars at different places; gates that differ from line to line without end.
    """
    ranges = _common_ranges([scan for _, scan, _ in scans])
    gates = [_gates(scan.range, ranges) for _, scan, _ in scans]
    lines = [len(scan.time) for _, scan, _ in scans]
    time = np.concatenate([scan.time for _, scan, _ in scans])
    remarks = [f"{name}: {text}" for name, scan, _ in scans for text in dict.fromkeys(scan.remarks)]
    order = np.argsort(time, kind="stable")
    back = int((np.diff(time.astype("int64")) < 0).sum())
    remarks += _about_times(scans, back)
    data: dict[str, Any] = {}
    for name, (unit, long_name) in FIELDS.items():
        if any(name in scan.fields for _, scan, _ in scans):
            full = np.full((sum(lines), ranges.size), np.nan, np.float32)
            _fill(full, [scan.fields.get(name) for _, scan, _ in scans], gates, lines)
            data[name] = ("time", "range"), full[order], _attributes(name, unit, long_name)
    flag = np.full((sum(lines), ranges.size), LineFlag.MISSING.value, np.uint16)
    _fill(flag, [flags for _, _, flags in scans], gates, lines)
    data["flag"] = (
        ("time", "range"),
        flag[order],
        flag_attributes(LineFlag, "reasons not to use the velocity"),
    )
    coords: dict[str, Any] = {
        "time": ("time", time[order], {"long_name": "time of the line (UTC)", "axis": "T"}),
        "range": variable("range", ranges, "m", "distance of the gate's centre from the lidar"),
    }
    for name, long_name in ANGLES.items():
        angles = [scan.angles.get(name) for _, scan, _ in scans]
        if any(values is not None for values in angles):
            values = [
                np.full(n, np.nan) if v is None else v for v, n in zip(angles, lines, strict=True)
            ]
            coords[name] = (
                "time",
                np.concatenate(values)[order],
                _attributes(name, "degree", long_name),
            )
    sweep = np.repeat(np.arange(len(scans)), lines)
    coords["sweep"] = variable("time", sweep[order], "1", "number of the scan")
    for name, value in _place([scan for _, scan, _ in scans]).items():
        coords[name] = (), value, _attributes(name, *PLACE[name])
    dataset = xr.Dataset(data, coords, _about(scans) | thresholds)
    dataset.attrs["scan"] = scan_kind(coords["azimuth"][1], coords["elevation"][1])
    dataset.attrs["remarks"] = "\n".join(remarks + _about_values(dataset))
    dataset["time"].encoding |= {"units": "seconds since 1970-01-01T00:00:00", "dtype": "float64"}
    return dataset


def scan_kind(azimuth: np.ndarray, elevation: np.ndarray) -> str:
    """How a lidar scans, from its angles in degrees.

    stare (one direction), rhi (elevations at one azimuth, or over the top), dbs (three to
    five directions above 40 degrees), ppi (azimuths at one elevation or
    at several, a VAD where they go round), or mixed.
    """
    east = np.cos(np.deg2rad(elevation)) * np.sin(np.deg2rad(azimuth))
    north = np.cos(np.deg2rad(elevation)) * np.cos(np.deg2rad(azimuth))
    up = np.sin(np.deg2rad(elevation))
    directions = np.unique(np.round(np.stack([east, north, up], -1) * 60).astype(int), axis=0) / 60
    if len(directions) == 1 or np.ptp(np.stack([east, north, up], -1), axis=0).max() < 0.02:
        return "stare"
    # of one vertical plane: the smallest spread of horizontal directions
    slanted = np.hypot(east, north) > 0.02
    axis = np.unique(np.round(np.mod(azimuth[slanted], 180.0)) % 180)
    if axis.size <= 2 and np.ptp(elevation) > 2 and len(directions) > 5:
        return "rhi"
    if 3 <= len(directions) <= 5 and (elevation > 40).all():
        return "dbs"
    steps = np.unique(np.round(elevation[slanted]))
    if steps.size <= max(1, len(directions) // 4):
        return "ppi"
    return "mixed"


def _common_ranges(scans: Sequence[Scan]) -> np.ndarray:
    values = np.concatenate([np.ravel(scan.range) for scan in scans])
    values = values[np.isfinite(values)]
    ranges = np.unique(np.round(values / _CENTIMETRE)) * _CENTIMETRE
    most = max(scan.range.shape[-1] for scan in scans)
    if ranges.size > _MOST_RANGES * most + 1:
        raise InputError(
            f"range: {ranges.size} different gates of lines of at most {most}; expected the same "
            "gates in all lines, or a few kinds of lines"
        )
    return ranges


def _gates(ranges: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Index of every gate on the common ranges; -1: no such gate."""
    finite = np.isfinite(ranges)
    nearest = np.searchsorted(common, np.where(finite, ranges, common[0]) - _CENTIMETRE)
    return np.where(finite, np.minimum(nearest, common.size - 1), -1)


def _fill(
    full: np.ndarray,
    parts: Sequence[np.ndarray | None],
    gates: Sequence[np.ndarray],
    lines: Sequence[int],
) -> None:
    start = 0
    for part, index, count in zip(parts, gates, lines, strict=True):
        if part is not None:
            columns = np.broadcast_to(index, part.shape)
            rows = np.broadcast_to(np.arange(start, start + count)[:, None], part.shape)
            inside = columns >= 0
            full[rows[inside], columns[inside]] = part[inside]
        start += count


def _attributes(name: str, unit: str, long_name: str) -> dict[str, str]:
    more = {"standard_name": _STANDARD[name]} if name in _STANDARD else {}
    return {"units": unit, "long_name": long_name, **more}


def _place(scans: Sequence[Scan]) -> dict[str, float]:
    """Where the lidar is, which must be one place."""
    place: dict[str, float] = {}
    for scan in scans:
        for name, value in scan.place.items():
            first = place.setdefault(name, value)
            if name != "altitude" and abs(value - first) > _SAME_PLACE:
                raise InputError(
                    f"{name}: {first:g} and {value:g} degrees; expected files of one lidar "
                    "at one place"
                )
    return place


def _about(scans: Sequence[tuple[str, Scan, np.ndarray]]) -> dict[str, str | float]:
    """Attributes that all scans share; of those that differ, all values as text."""
    attributes: dict[str, str | float] = {"Conventions": "CF-1.11", "title": "Lines of sight"}
    for key in dict.fromkeys(key for _, scan, _ in scans for key in scan.about):
        values = list(dict.fromkeys(s.about[key] for _, s, _ in scans if key in s.about))
        attributes[key] = values[0] if len(values) == 1 else ", ".join(map(str, values))
    attributes["source"] = ", ".join(dict.fromkeys(name for name, _, _ in scans))
    attributes["history"] = f"read by lidar-mi from {attributes['source']}"
    return attributes


def _about_times(scans: Sequence[tuple[str, Scan, np.ndarray]], back: int) -> list[str]:
    """Remarks on lines out of order, scans that overlap in time and lines that are there twice."""
    remarks = []
    within = sum(int((np.diff(s.time.astype("int64")) < 0).sum()) for _, s, _ in scans)
    if within:
        remarks.append(f"time goes back {within} times within a scan; lines are sorted by time")
    elif back:
        remarks.append("the scans are not in the order of time; lines are sorted by time")
    spans = sorted((s.time.min(), s.time.max(), name) for name, s, _ in scans)
    overlaps = [f"{a[2]} and {b[2]}" for a, b in pairwise(spans) if b[0] < a[1]]
    if overlaps:
        remarks.append(f"scans overlap in time: {', '.join(overlaps[:3])}; all lines are kept")
    keys = [
        key
        for _, s, _ in scans
        for key in zip(s.time.tolist(), s.angles["azimuth"], s.angles["elevation"], strict=True)
    ]
    if twice := len(keys) - len(set(keys)):
        remarks.append(f"{twice} lines have the time and the direction of another; all are kept")
    return remarks


def _about_values(lines: xr.Dataset) -> list[str]:
    """Remarks on gates without any value."""
    empty = ~np.isfinite(lines["radial_velocity"].values).any(0)
    if not empty.any():
        return []
    where = lines["range"].values[empty]
    return [f"{int(empty.sum())} gates, {where[0]:g} to {where[-1]:g} m, have no value in any line"]
