"""Range weighting of a coherent Doppler lidar along a line of sight."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.scans import LineScan, directions

WindField = Callable[
    [np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]
]
"""u, v, w (m/s) to the east, to the north and up of x, y, z (m, the same axes) and time (s)."""

_REACH = 4.5  # standard deviations of the pulse: 7e-6 of it is beyond
_ACROSS = 4  # directions of the quadrature over a moving beam: exact to degree 7


@dataclass(frozen=True)
class CoherentLidar:
    """A pulsed coherent Doppler lidar.

    wavelength: m.
    pulse_duration: full width at half maximum of the power, s.
    gate_length: of the time window of an estimate, m; gates closer than this overlap.
    first_gate, gate_step: middle of the first gate, distance of the next, m.
    """

    wavelength: float = 1.543e-6
    pulse_duration: float = 200e-9
    gate_length: float = 30.0
    first_gate: float = 105.0
    gate_step: float = 30.0
    gates: int = 100

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InputError(f"lidar.{name}: {value} is not allowed; expected above 0")
        if self.first_gate <= self.gate_length / 2:
            raise InputError(
                f"lidar.first_gate: {self.first_gate:g} m is not allowed with gates of "
                f"{self.gate_length:g} m; expected more than half of them"
            )

    @property
    def ranges(self) -> np.ndarray:
        """Middles of the gates, m."""
        return self.first_gate + self.gate_step * np.arange(self.gates)

    @property
    def pulse_length(self) -> float:
        """Full width at half maximum of the pulse in range, c tau / 2, m."""
        return scipy.constants.c * self.pulse_duration / 2

    @property
    def pulse_width(self) -> float:
        """Standard deviation of the spectrum of the pulse, m/s.

        A Gaussian power of standard deviation s in time has a spectrum of 1 / (4 pi s).
        """
        sigma = self.pulse_duration / math.sqrt(8 * math.log(2))
        return self.wavelength / 2 / (4 * math.pi * sigma)


def range_weight(offset: np.ndarray, lidar: CoherentLidar) -> np.ndarray:
    """Weight of the air at an offset (m) from the middle of a gate, 1/m; its integral is 1.

    The Gaussian pulse over the window of the gate: with a = 2 sqrt(ln 2) / pulse length,
    [erf(a (x + L/2)) - erf(a (x - L/2))] / (2 L) (Frehlich, Hannon & Henderson, Boundary-Layer
    Meteorol. 86, 233-256, 1998; Banakh & Smalikho, Coherent Doppler Wind Lidars in a Turbulent
    Atmosphere, 2013).
    """
    scale, half = 2 * math.sqrt(math.log(2)) / lidar.pulse_length, lidar.gate_length / 2
    upper, lower = scale * (offset + half), scale * (offset - half)
    return (scipy.special.erf(upper) - scipy.special.erf(lower)) / (2 * lidar.gate_length)


def echo_shift(ranges: np.ndarray, ratio: np.ndarray, lidar: CoherentLidar) -> np.ndarray:
    """Distance (m) of the middle of a gate's echo from the middle of the gate.

    Where the signal falls with range, the echo's middle is nearer: by the variance of
    `range_weight` times the slope of the logarithm of the signal, to first order in it.

    ranges, ratio (gates,): middles of the gates, m, and signal-to-noise ratio there, above 0.
    """
    variance = lidar.pulse_length**2 / (8 * math.log(2)) + lidar.gate_length**2 / 12
    return variance * np.gradient(np.log(ratio), ranges)


Signal = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Relative power of the echo at x, y, z (lines, points), in the order of range, and time."""


def gate_moments(
    wind: WindField,
    scan: LineScan,
    lidar: CoherentLidar,
    *,
    resolution: float = 1.0,
    signal: Signal | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments of the echo of every gate: radial velocity, its spread, relative power.

    wind: `WindField`, with the lidar at its origin.
    scan: every line at its own time; a moving beam averages over the angle that it moves through.
    resolution: distance of the points of the quadrature along a line, m: half of a vortex core or
        less.
    signal: `Signal`, such as backscatter times transmittance over the range squared. Default: 1
        everywhere.

    Returns
    -------
    mean, spread : (lines, gates) arrays
        m/s, positive away; the spread is the standard deviation, which widens the Doppler spectrum.
    power : (lines, gates) array
        Mean of the signal over every gate.
    """
    reach = lidar.gate_length / 2 + _REACH * lidar.pulse_length / math.sqrt(8 * math.log(2))
    near, far = max(lidar.ranges[0] - reach, 0.0), lidar.ranges[-1] + reach
    count = int(np.ceil((far - near) / resolution))
    # the trapezoidal rule of smooth functions that vanish at both ends converges fast
    distance = near + (far - near) * (np.arange(count) + 0.5) / count
    weight = range_weight(distance - lidar.ranges[:, None], lidar)
    weight /= weight.sum(1, keepdims=True)
    nodes, parts = np.polynomial.legendre.leggauss(_ACROSS)
    if not (scan.azimuth_span or scan.elevation_span):
        nodes, parts = np.zeros(1), np.full(1, 2.0)
    total = np.zeros((3, len(scan.time), lidar.gates))
    for node, part in zip(nodes / 2, parts / 2, strict=True):
        line = directions(
            scan.azimuth + node * scan.azimuth_span, scan.elevation + node * scan.elevation_span
        )
        x, y, z = (line[:, k, None] * distance for k in range(3))
        # of a beam that moves up and down in turn, the middle of its angles is that of its time
        time = np.broadcast_to(scan.time[:, None], x.shape)
        along = sum(w * line[:, k, None] for k, w in enumerate(wind(x, y, z, time)))
        power = np.ones(x.shape) if signal is None else signal(x, y, z, time)
        total += part * np.stack([(power * along**n) @ weight.T for n in range(3)])
    mean = total[1] / total[0]
    return mean, np.sqrt(np.maximum(total[2] / total[0] - mean**2, 0.0)), total[0]
