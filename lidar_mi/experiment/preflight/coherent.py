"""A coherent lidar and the air that passes it, in numbers, before a run."""

import math

import numpy as np

from lidar_mi.experiment.stages.coherent_lines import (
    coherent_lidar,
    line_scan,
    plane_place,
    receiver,
)
from lidar_mi.experiment.truth.passing_wake import PassingWake
from lidar_mi.instrument.coherent.velocity_noise import cramer_rao, random_velocity
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.units import shown

Rows = list[tuple[str, str]]


def coherent_rows(doppler: CoherentDoppler) -> Rows:
    """Pulses, gates, scans and the noise of a velocity."""
    laser, scan, signal = doppler.laser, doppler.scan, doppler.signal
    lines, lidar = line_scan(scan), coherent_lidar(doppler)
    heard = receiver(doppler)
    ratio = np.array(10 ** (signal.cnr / 10))
    noise = float(cramer_rao(ratio, np.array(lidar.pulse_width), heard.bandwidth, heard.samples))
    step = ""
    if scan.kind in ("rhi", "ppi"):
        angle = scan.rate * scan.accumulation
        # lines of a cone are nearer to each other the steeper they look
        level = math.cos(scan.elevation) if scan.kind == "ppi" else 1.0
        spacing = f"{angle * level * signal.range:.3g} m at {signal.range:g} m"
        step = f", {math.degrees(angle):.3g} deg or {spacing} apart"
    count = int(np.unique(lines.sweep).size)
    noise_text = f"{noise:.2g} m/s in uniform air at {signal.range:g} m"
    if noise > random_velocity(heard.bandwidth):
        noise_text = f"no signal at {signal.range:g} m: velocities there are random"
    return [
        ("laser", f"{shown(laser.wavelength, 'nm')}, pulses of {laser.pulse_length:g} m"),
        (
            "gates",
            f"{laser.gates} of {laser.gate_length:g} m from {laser.first_gate:g} to "
            f"{lidar.ranges[-1]:g} m, {laser.gate_spacing:g} m apart",
        ),
        ("scan", f"{scan.kind}, {count} of {scan.duration:.3g} s"),
        ("lines", f"{lines.time.size} of {shown(scan.accumulation, 's')}{step}"),
        ("duration", f"{lines.time[-1] + scan.accumulation / 2:.4g} s"),
        ("noise of a velocity", noise_text),
        ("largest velocity", f"{heard.bandwidth / 2:.3g} m/s"),
    ]


def passage_rows(doppler: CoherentDoppler, air: PassingWake) -> Rows:
    """The wind, and both vortices at the first and at the last line."""
    along, left = air.mean.at(np.array(doppler.passage.height))
    wind = f"{along:.3g} m/s along the flight, {left:.3g} m/s to its left"
    if air.wake is None:
        east, north = air.to_east_and_north(along, left)
        wind = f"{east:z.3g} m/s to the east, {north:z.3g} m/s to the north"
    rows = [("mean wind", wind)]
    if air.gusts is not None:
        rms = math.sqrt(float((air.gusts.amplitudes**2).sum()) / 6)
        rows.append(("turbulence", f"{rms:.2g} m/s rms of a component"))
    times = line_scan(doppler.scan).time
    for name, time in (("first", float(times[0])), ("last", float(times[-1]))):
        for side, core in zip(("port", "starboard"), air.vortices(time) or (), strict=False):
            where = f"y = {core.y:.4g} m, z = {core.z:.3g} m"
            if doppler.scan.kind == "rhi":
                where = f"{plane_place(doppler, core.y):.4g} m from the lidar, {core.z:.3g} m high"
            age = doppler.passage.age + time
            rows.append(
                (
                    f"{side} vortex at the {name} line",
                    f"{abs(core.circulation):.4g} m^2/s, {where}, age {age:.3g} s",
                )
            )
    return rows
