"""Lines of sight that a coherent Doppler lidar measures, as the data set of its files."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.scans import LineScan
from lidar_mi.instrument.coherent.velocity_noise import cramer_rao, random_velocity
from lidar_mi.instrument.coherent.weighting import CoherentLidar, Signal, WindField, gate_moments
from lidar_mi.variables import variable

START = np.datetime64("2000-01-01T00:00:00", "ns")
"""Time 0 of simulated lines."""


@dataclass(frozen=True)
class Receiver:
    """What a receiver makes of a line.

    samples: independent ones, of a gate times pulses of a line.
    bandwidth: as a range of velocities, m/s.
    """

    samples: float = 1e5
    bandwidth: float = 38.8


def measured_lines(
    wind: WindField,
    scan: LineScan,
    lidar: CoherentLidar,
    snr: float | np.ndarray | Callable[[np.ndarray], np.ndarray],
    receiver: Receiver | None = None,
    *,
    resolution: float = 1.0,
    signal: Signal | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Radial velocities with noise, in the layout of `read_lines_of_sight`.

    Noise is normal with the standard deviation of the Cramér-Rao bound. False estimates of weak
    signals, below some -20 dB, are not modelled. Where the bound exceeds the standard deviation of
    velocities uniform over the bandwidth, velocities are uniform, and flagged. Gates that overlap
    share their samples: noise at the distance x correlates by 1 - x / gate length.

    wind, scan, lidar, resolution, signal: as of `gate_moments`.
    snr (float, (gates,) array or callable of the range (m)): signal-to-noise ratio of the powers
        where the signal is 1, above 0.
    receiver: default: as `Receiver` has it.

    Raises InputError: a signal that is not above 0, or of another number of gates.

    Returns
    -------
    xr.Dataset, dims (time, range)
        `radial_velocity` (m s-1, positive away), `radial_velocity_stderr`, `radial_velocity_true`,
        `spectral_width` (of the pulse and of the wind within the gate), `snr`, `flag` (1: no
        signal);
        `azimuth` and `elevation` in degrees.
    """
    ranges = lidar.ranges
    ratio = np.asarray(snr(ranges) if callable(snr) else snr, float)
    if ratio.shape not in ((), ranges.shape):
        raise InputError(f"snr: shape {ratio.shape} is not allowed; expected ({ranges.size},)")
    receiver = receiver or Receiver()
    true, spread, power = gate_moments(wind, scan, lidar, resolution=resolution, signal=signal)
    width = np.hypot(lidar.pulse_width, spread)
    ratio = ratio * power
    stderr = cramer_rao(ratio, width, receiver.bandwidth, receiver.samples)
    random = np.random.default_rng(seed)
    shared = np.maximum(1 - np.abs(ranges - ranges[0]) / lidar.gate_length, 0.0)
    factor = np.linalg.cholesky(scipy.linalg.toeplitz(shared) + 1e-9 * np.eye(ranges.size))
    noise = random.standard_normal(true.shape) @ factor.T
    dims = "time", "range"
    most = random_velocity(receiver.bandwidth)
    lost = stderr > most
    stderr = np.where(lost, most, stderr)
    # normal numbers made uniform
    uniform = receiver.bandwidth * (scipy.special.ndtr(noise) - 0.5)
    measured = np.where(lost, uniform, true + stderr * noise)

    time = START + np.round(scan.time * 1e9).astype("timedelta64[ns]")
    degree = {"units": "degree"}
    return xr.Dataset(
        {
            "radial_velocity": variable(dims, measured, "m s-1", "radial velocity, positive away"),
            "radial_velocity_stderr": variable(
                dims, stderr, "m s-1", "standard error of the radial velocity"
            ),
            "radial_velocity_true": variable(dims, true, "m s-1", "radial velocity without noise"),
            "spectral_width": variable(dims, width, "m s-1", "width of the Doppler spectrum"),
            "snr": variable(dims, ratio, "1", "signal-to-noise ratio of the powers"),
            "flag": (
                dims,
                lost.astype(np.uint16),
                {"flag_masks": np.array([1], np.uint16), "flag_meanings": "no_signal"},
            ),
        },
        {
            "time": ("time", time),
            "range": ("range", ranges, {"units": "m"}),
            "azimuth": ("time", np.mod(np.rad2deg(scan.azimuth), 360), degree),
            "elevation": ("time", np.rad2deg(scan.elevation), degree),
            "sweep": ("time", scan.sweep),
        },
        {
            "Conventions": "CF-1.11",
            "gate_length": lidar.gate_length,
            "pulse_length": lidar.pulse_length,
            "seed": seed,
        },
    )
