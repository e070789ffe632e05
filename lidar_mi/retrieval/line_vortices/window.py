"""The part of a scan around vortices: averages of neighbouring lines, gates that hardly overlap."""

from dataclasses import dataclass

import numpy as np

from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.line_vortices.scan_plane import PlaneScan
from lidar_mi.retrieval.line_vortices.swirl import Lines, lines_of
from lidar_mi.retrieval.line_vortices.turbulence import of_gates, overlap

CELL = 1.5
"""Height of averages of lines, m: below half of a vortex core."""

MOST_CELLS = 750
"""Of a window: the covariance of more is too slow."""


@dataclass(frozen=True, eq=False)
class Window:
    """Averages of lines in the cells of a part of a scan.

    Attributes
    ----------
    lines : Lines
    line, gate : (n,) arrays of int
        Of the cells that are used.
    velocity : (n,) array
        m/s.
    noise : (n, n) array
        Covariance of the noise, (m/s)^2.
    lidar : CoherentLidar
    """

    lines: Lines
    line: np.ndarray
    gate: np.ndarray
    velocity: np.ndarray
    noise: np.ndarray
    lidar: CoherentLidar

    def turbulence(self, lengths: tuple[float, ...], wind: float) -> np.ndarray:
        """Covariances (lengths, n, n) of turbulence of unit variance that drifts with the wind."""
        lines = self.lines
        ranges, angle = lines.ranges[self.gate], lines.angle[self.line]
        time = lines.time[self.line]
        moved = wind * (time[:, None] - time)
        along = ranges[:, None] - ranges - moved * np.cos(angle)
        across = (ranges[:, None] + ranges) / 2 * (angle[:, None] - angle) + moved * np.sin(angle)
        cell = float(np.median(lines.span)) * float(lines.ranges.mean())
        full = of_gates(along, across, self.lidar, lengths, cell)
        # drift and range are those of one of the two
        return (full + full.transpose(0, 2, 1)) / 2

    @property
    def height(self) -> np.ndarray:
        """Of the cells above the lidar, m."""
        return self.lines.ranges[self.gate] * np.sin(self.lines.angle[self.line])


def window_of(
    scan: PlaneScan,
    lidar: CoherentLidar,
    ranges: tuple[float, float],
    angles: tuple[float, float],
    cell: float = CELL,
) -> Window | None:
    """Cells between two ranges (m) and two angles (rad); None: hardly any.

    Gates are left out until they are half a gate length apart or more; lines are averaged over
    ``cell`` at the middle of the ranges, and over more where there were too many cells.
    """
    gates = np.flatnonzero((scan.ranges >= ranges[0]) & (scan.ranges <= ranges[1]))
    lines = np.flatnonzero((scan.angle >= angles[0]) & (scan.angle <= angles[1]))
    if gates.size < 3 or lines.size < 4:
        return None
    step = float(np.median(np.diff(scan.ranges)))
    thin = max(1, int(np.floor(0.5 * lidar.gate_length / step + 0.01)))
    gates = gates[gates.size % thin // 2 :: thin]
    fine = max(scan.span, 1e-9) * (ranges[0] + ranges[1]) / 2
    many = max(1, round(cell / fine), int(np.ceil(lines.size * gates.size / MOST_CELLS)))
    starts = np.arange(0, lines.size - many // 2, many)
    part = np.ix_(lines, gates)
    velocity, variance = scan.velocity[part], scan.variance[part]
    usable = np.isfinite(velocity)
    number = np.add.reduceat(usable, starts, axis=0)
    total = np.maximum(number, 1)
    mean = np.add.reduceat(np.where(usable, velocity, 0.0), starts, axis=0) / total
    noise = np.add.reduceat(np.where(usable, variance, 0.0), starts, axis=0) / total**2
    counts = np.diff(np.append(starts, lines.size))
    angle = np.add.reduceat(scan.angle[lines], starts) / counts
    time = np.add.reduceat(scan.time[lines], starts) / counts
    line, gate = np.nonzero(number > counts[:, None] / 2)
    if line.size < 24 or np.unique(line).size < 4 or np.unique(gate).size < 3:
        return None
    size = np.sqrt(noise[line, gate])
    shared = overlap(scan.ranges[gates], lidar.gate_length)[gate[:, None], gate]
    covariance = shared * (line[:, None] == line) * size[:, None] * size
    rate = np.gradient(time, angle) if len(angle) > 1 else np.zeros(1)
    return Window(
        lines_of(time, angle, counts * scan.span, rate, scan.ranges[gates], lidar),
        line,
        gate,
        mean[line, gate],
        covariance,
        lidar,
    )
