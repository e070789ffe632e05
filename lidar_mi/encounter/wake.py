"""The wake of an encounter along the flight path."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.cores import Core, Rings, find_cores, ring_averages
from lidar_mi.atmosphere.vortex import Vortex
from lidar_mi.atmosphere.wake_path import PairAlongPath, WakeAlongPath
from lidar_mi.atmosphere.wake_volume import VolumeAlongPath, one_period
from lidar_mi.errors import InputError
from lidar_mi.experiment.input_files import find_file
from lidar_mi.experiment.schema.encounter import Encounter
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.schema.wake import Wake
from lidar_mi.experiment.truth.extinction import extinction_of
from lidar_mi.experiment.truth.flows import tracers_of
from lidar_mi.io.wake_file import read_wake


def encounter_of(experiment: Experiment) -> Encounter:
    """The encounter of an experiment.

    Raises
    ------
    InputError
        There is none.
    """
    if experiment.encounter is None:
        raise InputError(
            f"encounter: missing in {experiment.name}; expected the section of a flight through "
            "the wake"
        )
    return experiment.encounter


def wake_along_path(experiment: Experiment) -> WakeAlongPath:
    """Wind and vortices along the flight path.

    Raises
    ------
    InputError
        No encounter, or a wake that is not known along its axis.
    """
    encounter, wake = encounter_of(experiment), experiment.wake
    if wake is not None and wake.file:
        return _from_file(wake, wake.file, encounter, experiment.folder)
    if wake is None or wake.vortex_pair is None:
        found = "nothing" if wake is None else "turbine"
        raise InputError(
            f"wake: {found} is not allowed in an encounter, as it is not known along the wake's "
            "axis; expected wake.vortex_pair or wake.file"
        )
    pair, path = wake.vortex_pair, encounter.path
    return PairAlongPath(
        pair.circulation,
        pair.separation,
        pair.core_radius,
        pair.model,
        crossing_angle=path.crossing_angle,
        climb_angle=path.climb_angle,
        x_c=path.start,
        t_c=path.start / path.speed,
        miss=(path.miss.y, path.miss.z),
        decay_time=encounter.wake.decay_time,
        crow_amplitude=encounter.wake.crow.amplitude,
        crow_wavelength=encounter.wake.crow.wavelength,
    )


def vortices_in_plane(wake: WakeAlongPath, x: float, time: float) -> tuple[Vortex, Vortex] | None:
    """Port and starboard vortex in the plane x (m) at a time (s).

    None where the plane does not cut them: a wake at right angles to the path lies in it.
    """
    try:
        return wake.vortices(x, time)
    except InputError:
        return None


def _from_file(wake: Wake, file: str, encounter: Encounter, folder: Path) -> VolumeAlongPath:
    """A simulated wake: one plane, extruded, or a volume, repeated along its axis."""
    if wake.second != "advect":
        value = wake.second if wake.stored is None else f"{wake.stored:g} s"
        raise InputError(f"wake.second: {value} is not allowed in an encounter; expected advect")
    for key, given in (
        ("decay_time", encounter.wake.decay_time),
        ("crow.amplitude", encounter.wake.crow.amplitude),
    ):
        if given:
            raise InputError(
                f"encounter.wake.{key}: {given:g} is not allowed with wake.file; expected "
                "wake.vortex_pair"
            )
    path = find_file(file, folder, "wake.file")
    # its time of change: a file that is written anew is read anew
    flow, cores, drift = _volume(path, path.stat().st_mtime_ns, wake.model_dump_json())
    port, starboard = (tuple(_vortex(*one) for one in side) for side in cores)
    both = [*port, *starboard]
    middle = np.mean([one.y for one in both]), np.mean([one.z for one in both])
    y, z = wake.centre or middle
    x = wake.x if wake.x is not None and wake.depth == "volume" else float(flow["x"].mean())
    nominal = encounter.path
    return VolumeAlongPath(
        flow,
        port,
        starboard,
        background=wake.extinction.background,
        drift=drift,
        origin=(x, float(y), float(z)),
        crossing_angle=nominal.crossing_angle,
        climb_angle=nominal.climb_angle,
        x_c=nominal.start,
        t_c=nominal.start / nominal.speed,
        miss=(nominal.miss.y, nominal.miss.z),
    )


_OUTER = (15.0, 12.0, 10.0, 8.0)
"""Outer radius of the rings over which circulation and drift of a vortex are averaged, m."""

Section = tuple[Core, float]
"""A core in a plane of a volume, and its circulation from 5 m to 15 m or less, m^2 s^-1."""


Sides = tuple[list[Section], list[Section]]
"""Port and starboard."""


# check, flight and report need it again: cores in every plane take seconds to find
@lru_cache(maxsize=2)
def _volume(path: Path, stamp: int, keys: str) -> tuple[xr.Dataset, Sides, tuple[float, float]]:
    """One period of a file's wake with its extinction, its cores plane by plane, its drift."""
    wake = Wake.model_validate_json(keys)
    needed, names = tracers_of(wake)
    plane = wake.x if wake.depth == "plane" else None
    flow = read_wake(path, wake.time, names, plane, require=needed)
    if wake.depth == "plane" and flow.sizes["x"] > 1:
        raise InputError(
            f"wake.x: missing; {path.name} has {flow.sizes['x']} planes, expected one of "
            f"{float(flow['x'][0]):g} to {float(flow['x'][-1]):g} m (or wake.depth: volume)"
        )
    flow = one_period(flow)
    field = extinction_of(flow, wake.extinction, flow, None)
    flow = flow[[n for n in "uvw" if n in flow]].assign(extinction=field)
    sides: Sides = ([], [])
    drifts = []
    for index in range(flow.sizes["x"]):
        section = flow.isel(x=index)
        found = find_cores(section)
        if len(found) != 2:
            raise InputError(
                f"wake.file: {path.name} has {len(found)} vortices in the plane x = "
                f"{float(section['x']):g} m; expected two of opposite sense in every plane of an "
                "encounter"
            )
        for side, core, partner in zip(sides, found, found[::-1], strict=True):
            rings = _rings(section, core, partner)
            if rings is None:
                raise InputError(
                    f"wake.file: {path.name} has vortices in the plane x = "
                    f"{float(section['x']):g} m that are too close to each other or to the "
                    f"volume's edge; expected {_OUTER[-1]:g} m of their own flow about them"
                )
            side.append((core, rings.circulation))
            drifts.append((rings.v, rings.w))
    v, w = np.mean(drifts, axis=0)
    return flow, sides, (float(v), float(w))


def _rings(section: xr.Dataset, core: Core, partner: Core) -> Rings | None:
    """Averages over the widest rings within the plane and around no other core."""
    tried = (ring_averages(section, core, [partner], outer=outer) for outer in _OUTER)
    return next((rings for rings in tried if rings is not None), None)


def _vortex(core: Core, circulation: float) -> Vortex:
    return Vortex(circulation, core.radius, core.y, core.z)
