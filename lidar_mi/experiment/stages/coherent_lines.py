"""Lines of sight of a coherent lidar on the ground, with the true vortices beside them."""

import math
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.constants import c as SPEED_OF_LIGHT

from lidar_mi.atmosphere.vortices.vortex import Model, Vortex, angular_velocity
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.truth.passing_wake import PassingWake, echo, passing_wake
from lidar_mi.instrument.coherent.measurement import Receiver, measured_lines
from lidar_mi.instrument.coherent.scans import LineScan, dbs_scan, ppi_scan, rhi_scan, stare_scan
from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.schema.coherent import CoherentDoppler, CoherentScan
from lidar_mi.schema.wake import Wake
from lidar_mi.variables import variable

_RINGS = np.arange(5.0, 15.125, 0.25)  # m, as of `ring_averages`

VORTICES = ("port", "starboard")

_MOST_CELLS = 2e7  # lines times gates: 2 GB while they are measured
_STEPS = 4  # of the quadrature along a line in a gate or a pulse
_LEAST_ACROSS = 0.05  # of the scan's plane to the flight path: 3 degrees


def line_scan(scan: CoherentScan) -> LineScan:
    """Direction and time of every line."""
    if scan.kind == "stare":
        beams = stare_scan(scan.azimuth, scan.elevation, scan.accumulation, scan.count)
    elif scan.kind == "dbs":
        beams = dbs_scan(scan.elevation, scan.accumulation, move=scan.move, count=scan.count)
    elif scan.kind == "ppi":
        beams = ppi_scan(
            scan.elevation, scan.azimuths, scan.rate, scan.accumulation, count=scan.count
        )
    else:
        beams = rhi_scan(
            scan.azimuth, scan.elevations, scan.rate, scan.accumulation, count=scan.count
        )
    wait = 0.0 if scan.repeat is None else scan.repeat - scan.duration
    number = np.arange(scan.count) if scan.kind == "stare" else beams.sweep
    return LineScan(
        beams.time + wait * number,
        beams.azimuth,
        beams.elevation,
        beams.sweep,
        beams.azimuth_span,
        beams.elevation_span,
    )


def coherent_lidar(doppler: CoherentDoppler) -> CoherentLidar:
    """The instrument."""
    laser = doppler.laser
    return CoherentLidar(
        wavelength=laser.wavelength,
        pulse_duration=2 * laser.pulse_length / SPEED_OF_LIGHT,
        gate_length=laser.gate_length,
        first_gate=laser.first_gate,
        gate_step=laser.gate_spacing,
        gates=laser.gates,
    )


def receiver(doppler: CoherentDoppler) -> Receiver:
    """The receiver of the laser's light; samples of all pulses of a line."""
    laser = doppler.laser
    gate = 2 * laser.gate_length / SPEED_OF_LIGHT
    pulses = max(1.0, laser.pulse_rate * doppler.scan.accumulation)
    samples = max(1.0, gate * laser.bandwidth) * pulses
    return Receiver(samples, laser.bandwidth * laser.wavelength / 2)


def passing_air(
    doppler: CoherentDoppler, wake: Wake | None, seed: int, search_path: Path
) -> PassingWake:
    """The air that the lidar observes, until its last line."""
    last = float(line_scan(doppler.scan).time[-1]) + doppler.scan.accumulation
    return passing_wake(doppler, wake, seed, search_path, last)


def check_scan(doppler: CoherentDoppler, wake: Wake | None) -> None:
    """Refuse a scan that takes too much memory, or that is along the wake."""
    scan = doppler.scan
    cells = line_scan(scan).time.size * doppler.laser.gates
    if cells > _MOST_CELLS:
        raise InputError(
            f"doppler.scan: {cells:.2g} cells are not allowed; expected at most {_MOST_CELLS:g} "
            "(fewer scans, lines or gates)"
        )
    if scan.kind != "rhi" or wake is None:
        return
    if abs(_across(doppler)) < _LEAST_ACROSS:
        raise InputError(
            f"doppler.scan.azimuth: {math.degrees(scan.azimuth):.4g} deg is along the flight of "
            f"heading {math.degrees(doppler.passage.heading):.4g} deg; expected 3 degrees from it "
            "or more, so that the scan cuts the wake"
        )
    place = plane_place(doppler, 0.0)
    reach = doppler.laser.first_gate + doppler.laser.gate_spacing * (doppler.laser.gates - 1)
    if not 0 < place < reach:
        raise InputError(
            f"doppler.position: the wake begins {place:.4g} m ahead in the scan's plane; expected "
            f"above 0 and within the range of {reach:.4g} m"
        )


def coherent_lines(
    name: str,
    seed: int,
    doppler: CoherentDoppler,
    wake: Wake | None,
    passing_air: PassingWake,
    log: Log,
) -> xr.Dataset:
    """Radial velocities with noise, in the layout of `read_lines_of_sight`, beside the truth.

    Returns
    -------
    xr.Dataset
        As of `measured_lines`, with `radial_velocity_true`. Of an RHI through a wake also
        `vortex_y`, `vortex_z` (m: distance from the lidar along the scan's azimuth, height above
        it), `vortex_circulation` (m^2/s, positive from distance to height) and `wake_age` (s) of
        every line, dims (time, vortex).
    """
    laser, scan = doppler.laser, line_scan(doppler.scan)
    log.bar(f"{scan.time.size} lines of sight", None)
    lidar = coherent_lidar(doppler)
    finest = min(laser.gate_length, laser.pulse_length) / _STEPS
    pair = passing_air.vortices(float(scan.time[0]))
    if pair is not None:
        finest = min(finest, min(one.core_radius for one in pair) / 2)
    lines = measured_lines(
        passing_air.wind,
        scan,
        lidar,
        10 ** (doppler.signal.cnr / 10),
        receiver(doppler),
        resolution=finest,
        signal=echo(doppler, wake, passing_air),
        seed=seed,
    )
    lines["radial_velocity"] += doppler.bias
    lines.attrs |= {
        "title": f"{name}: lines of sight of a simulated coherent lidar",
        "kind": "simulated",
        "scan": doppler.scan.kind,
        "pulse_length": lidar.pulse_length,
    }
    if doppler.scan.kind != "rhi" or passing_air.wake is None:
        return lines
    return lines.assign(_true_vortices(doppler, passing_air, scan.time))


def plane_place(doppler: CoherentDoppler, y: float) -> float:
    """Distance (m) from the lidar along the scan's azimuth of a line along the flight at y."""
    return (y - doppler.position[1]) / _across(doppler)


def _across(doppler: CoherentDoppler) -> float:
    """Part of the scan's horizontal direction that is to the left of the flight."""
    return -math.sin(doppler.scan.azimuth - doppler.passage.heading)


def true_vortices(doppler: CoherentDoppler, air: PassingWake, times: np.ndarray) -> np.ndarray:
    """Port and starboard vortex in the scan's plane at times (s), (times, 2, 3).

    Distance along the azimuth and height above the lidar (m), circulation over rings of 5 to 15 m
    (m^2/s, positive from distance to height).
    """
    vortices = [air.vortices(float(time)) or () for time in times]
    # those of a simulated plane are averages already
    averaged = isinstance(air.wake, VolumeAlongPath)
    return np.array([[_in_plane(doppler, one, averaged) for one in pair] for pair in vortices])


def ring_fraction(core_radius: np.ndarray, model: Model) -> np.ndarray:
    """Circulation averaged over rings of 5 to 15 m (Holzaepfel et al. 2003) over that far away."""
    square = (_RINGS / core_radius[..., None]) ** 2
    return (2 * np.pi * square * angular_velocity(square, 1.0, 1.0, model)).mean(-1)


def _true_vortices(
    doppler: CoherentDoppler, air: PassingWake, times: np.ndarray
) -> dict[str, tuple[object, ...]]:
    rows, both = true_vortices(doppler, air, times), ("time", "vortex")
    age = doppler.passage.age + times

    return {
        "vortex": ("vortex", list(VORTICES)),
        "vortex_y": variable(
            both, rows[..., 0], "m", "true distance from the lidar along the scan's azimuth"
        ),
        "vortex_z": variable(both, rows[..., 1], "m", "true height above the lidar"),
        "vortex_circulation": variable(
            both,
            rows[..., 2],
            "m2 s-1",
            "true circulation, mean over rings of 5 to 15 m, positive from y to z",
        ),
        "wake_age": variable("time", age, "s", "age of the wake"),
    }


def _in_plane(
    doppler: CoherentDoppler, vortex: Vortex, averaged: bool
) -> tuple[float, float, float]:
    fraction = ring_fraction(np.array(vortex.core_radius), vortex.model)
    # seen from the other side, a vortex turns the other way
    turn = math.copysign(1.0, _across(doppler))
    return (
        plane_place(doppler, vortex.y),
        vortex.z - doppler.position[2],
        turn * vortex.circulation * (1.0 if averaged else float(fraction)),
    )
