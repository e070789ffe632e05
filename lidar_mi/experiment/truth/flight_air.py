"""The air of an encounter, for the aircraft, the images and the advection alike."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.air.along_path import AirAlongPath, LevelFrame, MovingAir
from lidar_mi.atmosphere.air.gust import Gust
from lidar_mi.atmosphere.air.microburst import Microburst
from lidar_mi.atmosphere.air.shear import LinearShear, LogarithmicShear
from lidar_mi.atmosphere.air.standards import design_gust_speed, flight_profile_alleviation
from lidar_mi.atmosphere.air.volume import AirVolume
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.turbulent_air import turbulence_scales, turbulent_air
from lidar_mi.experiment.truth.wake_along_path import (
    encounter_of,
    vortices_in_plane,
    wake_along_path,
)
from lidar_mi.io.wake_file import read_wake, wake_times
from lidar_mi.io.wind_box import read_bts, read_mann
from lidar_mi.schema import air as schema
from lidar_mi.schema import encounter as flight
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.section import Section
from lidar_mi.units import AS_GIVEN

# Planes across the path, in separations from the middle, over which a wake's drift is averaged.
_DRIFT_PLANES = (-1.0, -0.5, 0.0, 0.5, 1.0)


def air_along_path(experiment: Experiment) -> WakeAlongPath:
    """The wind of the wake and of all other air along the flight path.

    Raises InputError: no encounter, a wake that is not known along its axis, air out of range.
    """
    encounter, wake = encounter_of(experiment), wake_along_path(experiment)
    air, path = encounter.air, encounter.path
    if air is None:
        return wake
    parts = moving_air(air, path, experiment.seed)
    frame = LevelFrame(path.altitude, path.climb_angle)
    if air.volume is not None:
        volume = _volume(air.volume, experiment)
        _check_covered(volume, air.volume.file, experiment, wake, frame)
        parts = (volume, *parts)
    if not air.wake:
        return AirAlongPath(None, parts, frame)
    arrival = path.start / path.speed
    # no gusts: they are shorter than the wake and do not move it as a whole
    lasting = [part for part in parts if not isinstance(part, Gust)]
    drift = _drift(wake, lasting, frame, path.start, arrival)
    return AirAlongPath(wake, parts, frame, drift, arrival)


def moving_air(air: schema.Air, path: flight.Path, seed: int) -> tuple[MovingAir, ...]:
    """The parts of the air that are neither the wake nor read from a file.

    path: heights are above its ground; turbulence and gusts are those at its start.
    seed: of the experiment.
    """
    parts: list[MovingAir] = []
    if air.turbulence is not None:
        parts.append(turbulent_air(air.turbulence, path.altitude, seed, "encounter.air"))
    for gust in air.gusts:
        speed = _largest_speed(gust, path.altitude)
        parts.append(Gust(gust.direction, gust.gradient, gust.start, speed))
    if air.linear_shear is not None:
        shear = air.linear_shear
        parts.append(LinearShear(shear.du_dz, shear.dv_dz, path.altitude))
    if air.logarithmic_shear is not None:
        layer = air.logarithmic_shear
        parts.append(
            LogarithmicShear(
                layer.speed, layer.reference, layer.roughness, layer.towards, path.altitude
            )
        )
    if air.microburst is not None:
        burst = air.microburst
        parts.append(
            Microburst(burst.outflow, burst.radius, burst.outflow_height, burst.x, burst.y)
        )
    return tuple(parts)


def described(air: schema.Air, path: flight.Path) -> list[tuple[str, str]]:
    """The air in words: names of its parts, and a line for each."""
    rows = []
    if air.turbulence is not None:
        sigma, length = turbulence_scales(air.turbulence, path.altitude)
        kind = f"{air.turbulence.spectrum}, {air.turbulence.evolution}".replace("_", " ")
        rows.append(("turbulence", f"{sigma:.3g} m/s rms, length {length:.3g} m, {kind}"))
    if air.volume is not None:
        rows.append(("air of a simulation", air.volume.file))
    for gust in air.gusts:
        speed = _largest_speed(gust, path.altitude)
        where = f"{2 * gust.gradient:g} m long, from {gust.start:g} m on"
        rows.append(("gust", f"{speed:.3g} m/s {gust.direction}, {where}"))
    for name in ("linear_shear", "logarithmic_shear", "microburst"):
        part = getattr(air, name)
        if part is not None:
            rows.append((name.replace("_", " "), _keys(part)))
    return rows


def _keys(part: Section) -> str:
    values = part.model_dump(mode="json", context=AS_GIVEN)
    return ", ".join(f"{name} {value}" for name, value in values.items())


def _largest_speed(gust: schema.Gust, altitude: float) -> float:
    """Speed of a gust, m/s: as given, or the design speed."""
    if gust.speed is not None:
        return gust.speed
    factor = gust.alleviation or 1.0
    if gust.maximum_altitude is not None:
        factor = flight_profile_alleviation(
            altitude, gust.maximum_altitude, gust.landing_weight, gust.zero_fuel_weight
        )
    return design_gust_speed(altitude, gust.gradient, factor)


def _volume(settings: schema.AirVolume, experiment: Experiment) -> AirVolume:
    path = find_file(settings.file, experiment.folder, "encounter.air.volume.file")
    # the modification time: a changed file is read again
    height = encounter_of(experiment).path.altitude
    return _read_volume(path, path.stat().st_mtime_ns, settings.model_dump_json(), height)


# check, flight and lidar need it again: it takes seconds to read
@lru_cache(maxsize=1)
def _read_volume(path: Path, stamp: int, keys: str, height: float) -> AirVolume:
    settings = schema.AirVolume.model_validate_json(keys)
    flow = _flow(path, settings)
    start = float(flow["x"][0]) if settings.start is None else settings.start
    centre = float(flow["y"].mean()) if settings.centre is None else settings.centre
    return AirVolume(flow[["u", "v", "w"]], start, centre, height, settings.largest_divergence)


def _flow(path: Path, volume: schema.AirVolume) -> xr.Dataset:
    """The wind of a file on (x, y, z), or on (time, x, y, z) with 0 s as the path starts."""
    box = {".bts": "a field of TurbSim", ".bin": "a Mann box"}.get(path.suffix.lower())
    if box and (volume.time is not None or volume.series or volume.names):
        raise InputError(
            f"encounter.air.volume: time, series and names are not allowed with {box}, which has "
            "one state"
        )
    if (box == "a Mann box") != (volume.mann is not None):
        raise InputError(
            f"encounter.air.volume.mann: expected with a Mann box (.bin) and with no other file, "
            f"found {path.name}"
        )
    if volume.mann is not None:
        return read_mann(path, volume.mann.nodes, volume.mann.spacing, volume.mann.base)
    if box:
        return read_bts(path)
    if not volume.series:
        return read_wake(path, volume.time, volume.names, require=["u"])
    times = np.unique(wake_times(path, volume.names))
    if volume.time is None or not (times[:1] <= volume.time).all() or times.size < 2:
        listed = f"{times[0]:g} to {times[-1]:g} s" if times.size else "none"
        raise InputError(
            f"encounter.air.volume.series: needs a file of several times and `time`, one of them; "
            f"{path.name} has {listed}"
        )
    # the state at `time` is chosen as for a single state, whatever its rounding
    first = read_wake(path, volume.time, volume.names, require=["u"])
    chosen = [float(first["time"]), *times[times > float(first["time"])]]
    states = [first, *(read_wake(path, t, volume.names, require=["u"]) for t in chosen[1:])]
    return xr.concat(states, "time").assign_coords(time=np.array(chosen) - chosen[0])


def _check_covered(
    volume: AirVolume, file: str, experiment: Experiment, wake: WakeAlongPath, frame: LevelFrame
) -> None:
    """Refuse a volume that does not hold the wing along the path and, with a lidar, its images."""
    encounter = encounter_of(experiment)
    across, above = encounter.aircraft.span / 2, 0.0
    if encounter.control.mode == "feedforward":
        width, height = _image_size(experiment, wake)
        across, above = max(across, width / 2), height / 2
    along = np.array([0.0, encounter.path.start + encounter.path.beyond])
    last = along[1] / encounter.path.speed
    if volume.times.size > 1 and last > volume.times[-1] + 1e-6:
        raise InputError(
            f"encounter.air.volume.series: {file} goes on for {volume.times[-1]:g} s; the flight "
            f"takes {last:.4g} s"
        )
    x, z = frame.places(along[:, None], [-above, above])
    missing = volume.missing(x, [-across, across], z, last)
    for name, (first, last, low, high) in missing.items():
        key = {"x": "start", "y": "centre", "z": "path.altitude"}[name]
        raise InputError(
            f"encounter.air.volume.file: {file} covers {name} = {first:g} to {last:g} m; the "
            f"flight needs {low:.4g} to {high:.4g} m (a larger volume, a shorter path, or another "
            f"{key})"
        )


def _image_size(experiment: Experiment, wake: WakeAlongPath) -> tuple[float, float]:
    """Width and height of the lidar's images, m."""
    if isinstance(wake, VolumeAlongPath):
        return float(np.ptp(wake.flow["y"])), float(np.ptp(wake.flow["z"]))
    wake_section = experiment.wake
    assert wake_section is not None and wake_section.vortex_pair is not None  # an analytic wake
    return wake_section.vortex_pair.width, wake_section.vortex_pair.height


def _drift(
    wake: WakeAlongPath, parts: Sequence[MovingAir], frame: LevelFrame, x: float, time: float
) -> tuple[float, float, float]:
    """Mean wind (m/s) of the other air along both vortices, where and when the wake is met.

    Of a wake that lies across the path: at the place where the aircraft is then.
    """
    middle = vortices_in_plane(wake, x, time)
    places = [(x, 0.0, 0.0)]
    if middle:
        separation = abs(middle[0].y - middle[1].y)
        planes = [x + part * separation for part in _DRIFT_PLANES]
        places = [
            (plane, vortex.y, vortex.z)
            for plane in planes
            for vortex in vortices_in_plane(wake, plane, time) or ()
        ]
    at = np.array(places).T
    u, v, w = (float(a.mean()) for a in frame.wind(parts, *at, time))
    return u, v, w
