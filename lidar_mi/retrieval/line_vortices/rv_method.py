"""The method of radial velocities: vortices from the extremes of each gate, without error bars.

Smalikho, Banakh, Holzaepfel and Rahm, Opt. Express 23, A1194-A1207 (2015), as its steps are
described there; the usual peer of fits to whole scans.
"""

from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr

from lidar_mi.atmosphere.vortex import angular_velocity
from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.scans import LineScan
from lidar_mi.instrument.coherent.weighting import CoherentLidar, radial_velocities
from lidar_mi.retrieval.line_vortices.scan_plane import PlaneScan, plane_scans

_LEAST_APART = 20.0  # m in range, of both vortices
_ASIDE = 40.0  # m across the lines, of the velocities that a circulation is fitted to
_STEP = 1.0  # m, of the quadrature along a line


class _Extremes(NamedTuple):
    """Of a gate: middle angle (rad) and time (s) of the extremes, sense of rotation."""

    angle: float
    time: float
    sign: float


def radial_velocity_vortices(lines: xr.Dataset, *, core_radius: float = 3.0) -> xr.Dataset:
    """Two vortices of every vertical slice by the method of radial velocities.

    The mean wind is the median at every angle. The ranges of the vortices are those at which the
    largest and the smallest velocity differ most; their angles lie in the middle between both.
    Circulations follow by least squares from the velocities at these ranges, of
    Burnham-Hallock vortices through the range weighting.

    Parameters
    ----------
    lines : xr.Dataset
        As of `fit_vortices_to_lines`, with the attributes ``gate_length`` and ``pulse_length`` (m).
    core_radius : float
        m.

    Returns
    -------
    xr.Dataset, dims (scan, vortex)
        `y`, `z` (m), `circulation` (m^2/s) as of `fit_vortices_to_lines`, NaN where there is no
        second vortex; `time` (scan, vortex), at which the lines see each.

    Raises
    ------
    InputError
        As of `fit_vortices_to_lines`.
    """
    for name in ("gate_length", "pulse_length"):
        if not lines.attrs.get(name, 0) > 0:
            raise InputError(f"lines: the attribute {name} is missing; expected a length in m")
    values, times = [], []
    for scan in plane_scans(lines, None):
        found = _scan(scan, lines.attrs["gate_length"], lines.attrs["pulse_length"], core_radius)
        values.append(found[:, :3])
        times.append([scan.at(t) if np.isfinite(t) else np.datetime64("NaT") for t in found[:, 3]])
    data = np.array(values)
    return xr.Dataset(
        {
            name: (("scan", "vortex"), data[..., k], {"units": units})
            for k, (name, units) in enumerate((("y", "m"), ("z", "m"), ("circulation", "m2 s-1")))
        },
        {"time": (("scan", "vortex"), np.array(times, "datetime64[ns]"))},
        {"profile": "burnham_hallock", "core_radius": core_radius},
    )


def _scan(scan: PlaneScan, gate: float, pulse: float, core: float) -> np.ndarray:
    """y, z, circulation and time of both, the smaller y first."""
    velocity = scan.velocity - np.nanmedian(scan.velocity, axis=1, keepdims=True)
    spread = np.nanmax(velocity, axis=0) - np.nanmin(velocity, axis=0)
    first = int(np.argmax(spread))
    others = np.abs(scan.ranges - scan.ranges[first]) > _LEAST_APART
    # the next maximum, not the slope of the first
    peaks, _ = scipy.signal.find_peaks(spread)
    peaks = peaks[others[peaks]]
    if not peaks.size:
        return np.full((2, 4), np.nan)
    ranges, found = [], []
    for k in sorted((first, int(peaks[np.argmax(spread[peaks])]))):
        ranges.append(_summit(scan.ranges, spread, k))
        found.append(_extremes(scan, velocity[:, k]))
    strength = _circulations(scan, velocity, ranges, found, (gate, pulse), core)
    rows = [
        (r * np.cos(one.angle), r * np.sin(one.angle), gamma, one.time)
        for r, one, gamma in zip(ranges, found, strength, strict=True)
    ]
    return np.array(sorted(rows))


def _summit(ranges: np.ndarray, spread: np.ndarray, k: int) -> float:
    """Range of a maximum, by the parabola through it and its neighbours."""
    if not 0 < k < len(ranges) - 1:
        return float(ranges[k])
    left, middle, right = spread[k - 1 : k + 2]
    bend = left - 2 * middle + right
    shift = (left - right) / (2 * bend) if bend < 0 else 0.0
    return float(ranges[k] + np.clip(shift, -0.5, 0.5) * (ranges[k + 1] - ranges[k]))


def _extremes(scan: PlaneScan, column: np.ndarray) -> _Extremes:
    high, low = int(np.nanargmax(column)), int(np.nanargmin(column))
    # a vortex that turns from distance to height moves air to the lidar above its centre
    return _Extremes(
        float(scan.angle[high] + scan.angle[low]) / 2,
        float(scan.time[high] + scan.time[low]) / 2,
        1.0 if low > high else -1.0,
    )


def _circulations(
    scan: PlaneScan,
    velocity: np.ndarray,
    ranges: list[float],
    found: list[_Extremes],
    lengths: tuple[float, float],
    core: float,
) -> np.ndarray:
    """Both by least squares, with a constant at each range."""
    places = [
        (r * np.cos(one.angle), r * np.sin(one.angle)) for r, one in zip(ranges, found, strict=True)
    ]
    rows, right = [], []
    for k, (distance, one) in enumerate(zip(ranges, found, strict=True)):
        near = np.flatnonzero(np.abs(scan.angle - one.angle) * distance < _ASIDE)
        gate = int(np.argmin(np.abs(scan.ranges - distance)))
        near = near[np.isfinite(velocity[near, gate])]
        model = [_unit(scan.angle[near], distance, place, lengths, core) for place in places]
        constants = np.zeros((near.size, 2))
        constants[:, k] = 1.0
        rows.append(np.column_stack([*model, constants]))
        right.append(velocity[near, gate])
    solution, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)
    return solution[:2]


def _unit(
    angles: np.ndarray,
    distance: float,
    place: tuple[float, float],
    lengths: tuple[float, float],
    core: float,
) -> np.ndarray:
    """Radial velocities (angles,) at a distance of a vortex of unit circulation at y and z."""
    gate, pulse = lengths
    lidar = CoherentLidar(
        pulse_duration=2 * pulse / scipy.constants.c,
        gate_length=gate,
        first_gate=distance,
        gate_step=gate,
        gates=1,
    )

    def wind(
        x: np.ndarray, y: np.ndarray, z: np.ndarray, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        dy, dz = y - place[0], z - place[1]
        omega = angular_velocity(dy**2 + dz**2, 1.0, core, "burnham_hallock")
        return np.zeros_like(y), -omega * dz, omega * dy

    still = np.zeros_like(angles)
    # to the north, as y of the plane
    scan = LineScan(still, still, angles, still.astype(int))
    return radial_velocities(wind, scan, lidar, resolution=_STEP)[0][:, 0]
