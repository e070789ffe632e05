"""Lines of sight of one vertical slice (RHI) as arrays in its plane.

Plane: y horizontal distance from the lidar along the azimuth of the scan, z height above it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.ground_winds.source_name import source_name

_OUT_OF_PLANE = 0.05  # sine of the angle of a line with the plane: 3 degrees
_PAUSE = 10  # times the time from line to line
STANDING = ("step", "point", "stop")
"""In the name of a scan whose beam stands while it measures, as `Step` and `Stepped` of Halo."""

_LEAST_LINES = 8
_LEAST_GATES = 4


@dataclass(frozen=True, eq=False)
class PlaneScan:
    """One slice, its lines in the order of their angle.

    start (datetime64): time of the first line.
    time (lines,): s after the start.
    angle (lines,): from the y axis upwards, rad; above pi/2: over the top.
    ranges (gates,): m.
    velocity (lines, gates): away from the lidar, m/s; NaN: not usable.
    variance (lines, gates): of the noise, (m/s)^2.
    step: angle from line to line, rad.
    sweeps: whether the beam moves through this angle while it measures; else it stands.
    clock: resolution of the times if it is coarser than the lines, s; 0: finer.
    azimuth: of the y axis, degrees.
    sweep: its number in the data set.
    stated {"gates", "least", "none"}: whether the noise is known for every gate, is the least one,
        or is estimated.
    """

    start: np.datetime64
    time: np.ndarray
    angle: np.ndarray
    ranges: np.ndarray
    velocity: np.ndarray
    variance: np.ndarray
    step: float
    sweeps: bool
    clock: float
    azimuth: float
    sweep: int
    stated: Literal["gates", "least", "none"]

    @property
    def span(self) -> float:
        """Angle that the beam moves through in the time of a line, rad."""
        return self.step if self.sweeps else 0.0

    def at(self, seconds: float) -> np.datetime64:
        """Time of day of so many seconds after the start."""
        return self.start + np.timedelta64(round(1e9 * seconds), "ns")


def plane_scans(lines: xr.Dataset, noise: float | None) -> tuple[list[PlaneScan], list[str]]:
    """The slices of a data set of `read_lines_of_sight`, and remarks on lines that are in none.

    A slice is a part of a sweep in which the beam moves one way.

    Raises InputError: a data set without lines of sight; lines that are not in one vertical plane;
    no slice of 8 lines and 4 gates with usable values.
    """
    for name in ("radial_velocity", "flag", "azimuth", "elevation", "range", "time"):
        if name not in lines.variables:
            raise InputError(
                f"lines: {name} is missing; expected a data set of read_lines_of_sight"
            )
    known = np.isfinite(lines["azimuth"].values) & np.isfinite(lines["elevation"].values)
    lines = lines.isel(time=np.flatnonzero(known & ~np.isnat(lines["time"].values)))
    lines = lines.isel(time=np.argsort(lines["time"].values, kind="stable"))
    usable = (lines["flag"].values == 0) & np.isfinite(lines["radial_velocity"].values)
    common = _azimuth(*(np.deg2rad(lines[name].values) for name in ("azimuth", "elevation")))
    sweep = lines["sweep"].values if "sweep" in lines.coords else np.zeros(len(usable), int)
    scans, lost, few = [], int((~known).sum()), "0 lines and 0 gates"
    for number in np.unique(sweep):
        whole = np.flatnonzero(sweep == number)
        swept = lines.isel(time=whole)
        # angles in the plane do not jump at the zenith, as azimuths do
        azimuth, elevation = (np.deg2rad(swept[name].values) for name in ("azimuth", "elevation"))
        forward = np.cos(elevation) * np.cos(azimuth - common)
        for part in _passes(np.arctan2(np.sin(elevation), forward), swept["time"].values):
            index = whole[part]
            valid = usable[index]
            if valid.any(1).sum() < _LEAST_LINES or valid.any(0).sum() < _LEAST_GATES:
                few = f"{valid.any(1).sum()} lines and {valid.any(0).sum()} gates"
                lost += len(index)
                continue
            scans.append(_plane_scan(lines.isel(time=index), noise, int(number), common))
    if not scans:
        raise InputError(
            f"{source_name(lines)}: {few} with usable values in a scan; expected {_LEAST_LINES} "
            f"and {_LEAST_GATES} or more"
        )
    remark = f"{lost} lines are in no scan of {_LEAST_LINES} lines and {_LEAST_GATES} gates"
    return scans, [remark] if lost else []


def _passes(angle: np.ndarray, time: np.ndarray) -> list[slice]:
    """Parts (in the order of time) in which the angle rises, or falls, without a pause."""
    if len(angle) < 2:
        return [slice(None)]
    steps, seconds = np.diff(angle), np.diff(time) / np.timedelta64(1, "s")
    signs = np.sign(np.where(np.abs(steps) > 0.2 * np.median(np.abs(steps)), steps, 0.0))
    # times of a clock are late by up to its resolution
    clock = _clock(seconds)
    usual = (seconds.sum() / seconds.size) if clock else np.median(seconds)
    pause = seconds - clock > _PAUSE * usual
    starts, direction = [0], 0.0
    for k in np.flatnonzero(pause | (signs != 0)):
        if pause[k] or (direction and signs[k] != direction):
            starts.append(int(k) + 1)
            direction = 0.0
        else:
            direction = signs[k]
    ends = [*starts[1:], len(angle)]
    # jitter larger than the steps looks like turns: one pass
    if len(angle) < _LEAST_LINES * len(starts):
        return [slice(None)]
    return [slice(start, end) for start, end in zip(starts, ends, strict=True)]


def _clock(steps: np.ndarray) -> float:
    """Resolution of times in which several lines are equal, s; 0: none are.

    Lines stored twice do not count: a clock repeats a fifth of all times or more.
    """
    positive = steps[steps > 0]
    if not positive.size or np.mean(steps == 0) < 0.2:
        return 0.0
    return float(positive.min())


def _regular(seconds: np.ndarray, clock: float) -> np.ndarray:
    """Times of lines from those of a clock that cuts them off, s: evenly spaced lines.

    Where no even spacing is within the clock's resolution, lines are evenly spread over each time.
    """
    number = np.arange(len(seconds))
    slope, start = np.polyfit(number, seconds, 1)
    even = start + slope * number
    if np.abs(even - seconds).max() <= clock:
        return np.asarray(even + clock / 2)
    _, first, counts = np.unique(seconds, return_index=True, return_counts=True)
    within = (number - np.repeat(first, counts) + 0.5) / np.repeat(counts, counts)
    return np.asarray(seconds + clock * within)


def _plane_scan(lines: xr.Dataset, noise: float | None, number: int, common: float) -> PlaneScan:
    azimuth, elevation = np.deg2rad(lines["azimuth"].values), np.deg2rad(lines["elevation"].values)
    along = common
    if not _out_of_plane(azimuth, elevation, along) < _OUT_OF_PLANE:
        along = _azimuth(azimuth, elevation)
    forward = np.cos(elevation) * np.cos(azimuth - along)
    aside = _out_of_plane(azimuth, elevation, along)
    if not aside < _OUT_OF_PLANE:
        raise InputError(
            f"{source_name(lines)}: scan {number} leaves the vertical plane of azimuth "
            f"{np.rad2deg(along):.1f} degrees by {np.rad2deg(np.arcsin(min(aside, 1))):.1f} "
            "degrees; expected an RHI"
        )
    angle = np.arctan2(np.sin(elevation), forward)
    order = np.argsort(angle, kind="stable")
    usable = (lines["flag"].values == 0) & np.isfinite(lines["radial_velocity"].values)
    velocity = np.where(usable, lines["radial_velocity"].values.astype(float), np.nan)[order]
    gates = np.flatnonzero(usable.any(0))
    if not np.ptp(angle) > 0:
        raise InputError(
            f"{source_name(lines)}: scan {number} looks in one direction; expected an RHI"
        )
    part = slice(gates[0], gates[-1] + 1)
    velocity = velocity[:, part]
    if "radial_velocity_stderr" in lines:
        stated: Literal["gates", "least", "none"] = "gates"
        variance = lines["radial_velocity_stderr"].values.astype(float)[order][:, part] ** 2
    elif noise is not None:
        variance, stated = np.full(velocity.shape, noise**2), "least"
    else:
        variance, stated = _noise_variance(velocity), "none"
    velocity = np.where(np.isfinite(variance), velocity, np.nan)
    time = lines["time"].values
    seconds = (time - time.min()) / np.timedelta64(1, "s")
    clock = _clock(np.diff(seconds))
    if clock:
        seconds = _regular(seconds, clock)
    words = str(lines.attrs.get("scan_type", "")).lower()
    return PlaneScan(
        time.min(),
        seconds[order],
        angle[order],
        lines["range"].values.astype(float)[part],
        velocity,
        variance,
        float(np.median(np.diff(angle[order]))),
        not any(word in words for word in STANDING),
        clock,
        float(np.rad2deg(along) % 360),
        number,
        stated,
    )


def _out_of_plane(azimuth: np.ndarray, elevation: np.ndarray, along: float) -> float:
    """Largest distance of the directions from a vertical plane, of unit vectors."""
    return float(np.abs(np.cos(elevation) * np.sin(azimuth - along)).max())


def _azimuth(azimuth: np.ndarray, elevation: np.ndarray) -> float:
    """Azimuth of the plane, rad: the one of the lines, or of most of those over the top."""
    # twice the angle is the same on both sides of the zenith
    weight = np.cos(elevation) ** 2
    double = np.arctan2((weight * np.sin(2 * azimuth)).sum(), (weight * np.cos(2 * azimuth)).sum())
    sign = np.sum(np.cos(elevation) * np.cos(azimuth - double / 2))
    return float(double / 2 + (np.pi if sign < 0 else 0.0))


def _noise_variance(velocity: np.ndarray) -> np.ndarray:
    """Variance of independent noise from second differences of three lines, each gate its own.

    It is robust, from the median of their absolute values; differences of the air from line to line
    add to it.
    """
    second = velocity[:-2] - 2 * velocity[1:-1] + velocity[2:]
    known = np.isfinite(second).any(0)
    size = np.full(velocity.shape[1], np.nan)
    size[known] = 1.4826 * np.nanmedian(np.abs(second[:, known]), axis=0)
    size = np.where(known, size, np.nanmedian(size))
    return np.broadcast_to(np.maximum(size, 0.01) ** 2 / 6, velocity.shape).copy()
