"""Scans of a Doppler lidar on the ground: direction and time of every line.

Directions are to the east, to the north and up; azimuths are clockwise from north.
"""

from dataclasses import dataclass

import numpy as np

from lidar_mi.errors import InputError


@dataclass(frozen=True, eq=False)
class LineScan:
    """Lines of sight, each at the middle of its accumulation.

    time (lines,): s.
    azimuth, elevation (lines,): rad.
    sweep (lines,): number of the scan.
    azimuth_span, elevation_span: angle that the beam moves through while it accumulates, rad.
    """

    time: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    sweep: np.ndarray
    azimuth_span: float = 0.0
    elevation_span: float = 0.0


def directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3) to the east, to the north and up, of angles in rad."""
    cos = np.cos(elevation)
    east, north, up = np.sin(azimuth) * cos, np.cos(azimuth) * cos, np.sin(elevation)
    return np.stack(np.broadcast_arrays(east, north, up), axis=-1)


def rhi_scan(
    azimuth: float,
    elevation: tuple[float, float],
    rate: float,
    accumulation: float,
    *,
    count: int = 1,
    turn: float = 0.0,
) -> LineScan:
    """Vertical slices at one azimuth, up and down in turn.

    azimuth: rad.
    elevation: first and last, rad; above pi/2: over the top.
    rate: angular speed, rad/s.
    accumulation: time of a line, s: a line every accumulation, without gaps.
    count: slices.
    turn: time between slices, s.
    """
    time, angle, sweep = _swept(elevation, rate, accumulation, count, turn, back=True)
    return LineScan(
        time, np.full(time.shape, azimuth), angle, sweep, elevation_span=rate * accumulation
    )


def ppi_scan(
    elevation: float,
    azimuth: tuple[float, float],
    rate: float,
    accumulation: float,
    *,
    count: int = 1,
    turn: float = 0.0,
) -> LineScan:
    """Cones at one elevation, always from the first azimuth to the last; as of `rhi_scan`."""
    time, angle, sweep = _swept(azimuth, rate, accumulation, count, turn, back=False)
    return LineScan(
        time, angle, np.full(time.shape, elevation), sweep, azimuth_span=rate * accumulation
    )


def dbs_scan(
    elevation: float,
    accumulation: float,
    *,
    move: float = 1.0,
    vertical: bool = True,
    count: int = 1,
) -> LineScan:
    """Beams to the north, east, south and west, and a vertical one, step by step.

    elevation: of the slanted beams, rad.
    accumulation, move: time of a beam, and from one to the next, s.
    count: cycles.
    """
    _check(accumulation=accumulation, count=count)
    azimuth = np.append(np.arange(4) * np.pi / 2, [0.0] if vertical else [])
    angle = np.append(np.full(4, elevation), [np.pi / 2] if vertical else [])
    number = np.arange(count * azimuth.size)
    return LineScan(
        number * (accumulation + move) + accumulation / 2,
        np.tile(azimuth, count),
        np.tile(angle, count),
        number // azimuth.size,
    )


def stare_scan(azimuth: float, elevation: float, accumulation: float, count: int) -> LineScan:
    """Lines in one direction (rad), one after another."""
    _check(accumulation=accumulation, count=count)
    time = (np.arange(count) + 0.5) * accumulation
    same = np.ones(count)
    return LineScan(time, azimuth * same, elevation * same, np.zeros(count, int))


def _swept(
    ends: tuple[float, float],
    rate: float,
    accumulation: float,
    count: int,
    turn: float,
    *,
    back: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    _check(rate=rate, accumulation=accumulation, count=count)
    step = rate * accumulation
    lines = int(np.floor(abs(ends[1] - ends[0]) / step + 1e-9))
    if lines < 1:
        raise InputError(
            f"scan: {abs(ends[1] - ends[0]):g} rad are not allowed with {step:g} rad a line; "
            "expected one line or more"
        )
    sweep = ends[0] + np.sign(ends[1] - ends[0]) * (np.arange(lines) + 0.5) * step
    number = np.arange(count)
    angle = [sweep[::-1] if back and k % 2 else sweep for k in number]
    start = number[:, None] * (lines * accumulation + turn)
    time = start + (np.arange(lines) + 0.5) * accumulation
    return time.ravel(), np.concatenate(angle), np.repeat(number, lines)


def _check(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise InputError(f"scan.{name}: {value} is not allowed; expected a number above 0")
