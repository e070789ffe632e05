"""Covariance of radial velocities of a scan by turbulence and by noise."""

import functools

import numpy as np

from lidar_mi.instrument.coherent.weighting import CoherentLidar, range_weight
from lidar_mi.retrieval.ground_winds.turbulence_covariance import correlations

LENGTHS = (25.0, 75.0, 225.0)
"""Length scales of turbulence that are considered, m."""

_STEP, _FINE = 2.5, 0.5  # m, of the tables along and across the lines
_ALONG, _ACROSS = 320.0, 240.0  # m, their ends


@functools.lru_cache(maxsize=16)
def _table(pulse_duration: float, gate_length: float, cell: int, length: float) -> np.ndarray:
    """Covariance (along, across) of two gates of parallel lines, of unit variance of the wind.

    Of averages over a cell of so many fine steps across the lines.
    """
    lidar = CoherentLidar(
        pulse_duration=pulse_duration, gate_length=gate_length, first_gate=gate_length
    )
    reach = _STEP * np.ceil((gate_length / 2 + 2 * lidar.pulse_length) / _STEP)
    offset = np.arange(-reach, reach + _STEP / 2, _STEP)
    weight = range_weight(offset, lidar)
    pair = np.convolve(weight / weight.sum(), weight / weight.sum())
    along = np.arange(0.0, _ALONG + _STEP / 2, _STEP)
    across = np.arange(-cell * _FINE, _ACROSS + (cell + 0.5) * _FINE, _FINE)
    extended = np.arange(-2 * reach, _ALONG + 2 * reach + _STEP / 2, _STEP)
    # a cell's mean square distance, so that small eddies within it count
    square = extended[:, None] ** 2 + across**2
    distance = np.sqrt(square + (_STEP**2 + _FINE**2) / 12)
    f, g = correlations(distance, length)
    full = g + (f - g) * extended[:, None] ** 2 / np.maximum(square, 1e-9)
    windows = np.lib.stride_tricks.sliding_window_view(full, len(pair), axis=0)
    full = (windows @ pair)[: len(along)]
    # two averages over a cell differ in place by a triangle of twice its width
    triangle = np.convolve(np.ones(cell), np.ones(cell)) / cell**2
    if cell == 1:
        return full[:, 1:-1]
    columns = np.lib.stride_tricks.sliding_window_view(full[:, 1:-1], len(triangle), axis=1)
    return columns @ triangle


def of_gates(
    along: np.ndarray,
    across: np.ndarray,
    lidar: CoherentLidar,
    lengths: tuple[float, ...],
    cell: float,
) -> np.ndarray:
    """Covariances (lengths, ...) of gates at distances along and across their lines, m.

    Lines are taken for parallel, each is an average over a cell (m) across; the variance of each
    component of the wind is 1.
    """
    steps = max(1, round(cell / _FINE))
    tables = np.stack(
        [_table(lidar.pulse_duration, lidar.gate_length, steps, length) for length in lengths], -1
    )
    last = np.array(tables.shape[:2]) - 1.001
    row = np.minimum(np.abs(along) / _STEP, last[0])
    column = np.minimum(np.abs(across) / _FINE, last[1])
    r, c = row.astype(np.int32), column.astype(np.int32)
    dr, dc = (row - r)[..., None], (column - c)[..., None]
    flat, width = tables.reshape(-1, len(lengths)), tables.shape[1]
    at = r * width + c
    low = flat[at] * (1 - dc) + flat[at + 1] * dc
    high = flat[at + width] * (1 - dc) + flat[at + width + 1] * dc
    return np.moveaxis(low * (1 - dr) + high * dr, -1, 0)


def overlap(ranges: np.ndarray, gate_length: float) -> np.ndarray:
    """Correlation (gates, gates) of the noise of gates that share samples: 1 - x / length."""
    return np.maximum(1 - np.abs(ranges[:, None] - ranges) / gate_length, 0.0)
