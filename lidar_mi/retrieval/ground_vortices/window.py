"""The part of a scan around vortices: averages of neighbouring lines, gates that hardly overlap."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.ground_vortices.scan_plane import PlaneScan
from lidar_mi.retrieval.ground_vortices.swirl import Lines, lines_of
from lidar_mi.retrieval.ground_vortices.turbulence import of_gates, overlap

CELL = 1.5
"""Height of averages of lines, m: below half of a vortex core."""

MOST_CELLS = 750
"""Of a window: the covariance of more is too slow."""

_NEIGHBOURS = 7, 3  # lines and gates of an estimate of the noise
_LEAST_NOISE = 0.005  # m/s: rounding of the velocities


@dataclass(frozen=True, eq=False)
class Window:
    """Averages of lines in the cells of a part of a scan.

    ``line`` and ``gate`` are of the n cells used, with their velocity (m/s) and its noise (n, n),
    (m/s)^2.
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
        middle = lines.angle.mean()
        # in the frame of the air, along the middle line and across it
        drift = wind * lines.time[self.line]
        along = ranges * np.cos(angle - middle) - drift * np.cos(middle)
        across = ranges * np.sin(angle - middle) + drift * np.sin(middle)
        cell = float(np.median(lines.span)) * float(lines.ranges.mean())
        return of_gates(along[:, None] - along, across[:, None] - across, self.lidar, lengths, cell)

    def with_noise_of(self, residual: np.ndarray, *, limited: bool) -> "Window":
        """The same with the noise that the residuals (n,) of neighbouring lines show.

        If ``limited``, no less than the present one.

        It is estimated from their second differences over seven lines and three gates, as
        velocities are less certain where the vortices widen the spectra.
        """
        lines = self.lines
        full = np.full((len(lines.time), len(lines.ranges)), np.nan)
        full[self.line, self.gate] = residual
        square = np.full(full.shape, np.nan)
        square[1:-1] = (full[:-2] - 2 * full[1:-1] + full[2:]) ** 2 / 6
        known = np.isfinite(square)
        total, number = (
            scipy.ndimage.uniform_filter(array, _NEIGHBOURS, mode="constant")
            for array in (np.where(known, square, 0.0), known.astype(float))
        )
        everywhere = float(square[known].mean())
        local = np.where(number > 0.3, total / np.maximum(number, 0.01), everywhere)
        least = np.diag(self.noise) if limited else _LEAST_NOISE**2
        size = np.sqrt(np.maximum(local[self.line, self.gate], least))
        return replace(self, noise=_noise(self.line, self.gate, size, lines.ranges, self.lidar))

    @property
    def height(self) -> np.ndarray:
        """Height of the cells above the lidar, m."""
        return self.lines.ranges[self.gate] * np.sin(self.lines.angle[self.line])


def _noise(
    line: np.ndarray, gate: np.ndarray, size: np.ndarray, ranges: np.ndarray, lidar: CoherentLidar
) -> np.ndarray:
    """Covariance of the noise of cells of standard deviations (n,)."""
    shared = overlap(ranges, lidar.gate_length)[gate[:, None], gate]
    return shared * (line[:, None] == line) * size[:, None] * size


def window_of(
    scan: PlaneScan,
    lidar: CoherentLidar,
    ranges: tuple[float, float],
    angles: tuple[float, float],
    cell: float = CELL,
) -> Window | None:
    """Cells between two ranges (m) and two angles (rad); None: hardly any.

    Gates are thinned to half a gate length or more; lines are averaged over ``cell`` at the middle
    of the ranges, or over more to limit the number of cells.
    """
    gates = np.flatnonzero((scan.ranges >= ranges[0]) & (scan.ranges <= ranges[1]))
    lines = np.flatnonzero((scan.angle >= angles[0]) & (scan.angle <= angles[1]))
    if gates.size < 3 or lines.size < 4:
        return None
    step = float(np.median(np.diff(scan.ranges)))
    thin = max(1, int(np.floor(0.5 * lidar.gate_length / step + 0.01)))
    gates = gates[gates.size % thin // 2 :: thin]
    fine = max(scan.step, 1e-9) * (ranges[0] + ranges[1]) / 2
    averaged = max(1, round(cell / fine), int(np.ceil(lines.size * gates.size / MOST_CELLS)))
    starts = np.arange(0, lines.size - averaged // 2, averaged)
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
    covariance = _noise(line, gate, size, scan.ranges[gates], lidar)
    turn = np.gradient(angle)
    rate = np.gradient(time) / np.where(np.abs(turn) > 1e-9, turn, np.inf)
    return Window(
        lines_of(
            time, angle, (counts - 1) * scan.step + scan.span, rate, scan.ranges[gates], lidar
        ),
        line,
        gate,
        mean[line, gate],
        covariance,
        lidar,
    )
