"""The wake of an encounter along the flight path."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core, Rings, find_cores, ring_averages
from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.atmosphere.vortices.wake_period import Closing, Ends, one_period
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.aged_wake import analytic_wake, described_pair
from lidar_mi.experiment.truth.extinction import extinction_of
from lidar_mi.experiment.truth.flows import tracers_of
from lidar_mi.io.wake_file import read_wake
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.wake import Wake


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
    return analytic_wake(wake.vortex_pair, encounter)


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
        ("age", encounter.wake.age),
        ("decay_time", encounter.wake.decay_time),
        ("dissipation_rate", encounter.wake.dissipation_rate),
        ("crow.amplitude", encounter.wake.crow.amplitude),
    ):
        if given:
            raise InputError(
                f"encounter.wake.{key}: {given:g} is not allowed with wake.file; expected "
                "wake.vortex_pair"
            )
    flow, cores, drift, _ = _period_of(wake, file, encounter, folder)
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


def _period_of(
    wake: Wake, file: str, encounter: Encounter, folder: Path
) -> tuple[xr.Dataset, "Sides", tuple[float, float], Closing]:
    path = find_file(file, folder, "wake.file")
    # its time of change: a file that is written anew is read anew
    stamp, ends = path.stat().st_mtime_ns, encounter.wake
    return _volume(path, stamp, wake.model_dump_json(), ends.ends, ends.ends_length)


def described_wake(experiment: Experiment) -> list[tuple[str, str]]:
    """The wake of an encounter, if any, in words: a name and a line for each property.

    Raises
    ------
    InputError
        As of `wake_along_path`.
    """
    encounter, wake = encounter_of(experiment), experiment.wake
    if encounter.air is not None and not encounter.air.wake:
        return []
    if wake is not None and wake.vortex_pair is not None:
        return described_pair(wake.vortex_pair, encounter)
    along = wake_along_path(experiment)
    assert wake is not None and wake.file and isinstance(along, VolumeAlongPath)
    _, sides, _, closing = _period_of(wake, wake.file, encounter, experiment.folder)
    strength = [np.array([abs(circulation) for _, circulation in side]) for side in sides]
    mean = float(np.mean(strength))
    rows = [("vortices when met", f"{mean:.4g} m^2/s, of {wake.file}, frozen in this state")]
    if closing.how == "uniform":
        return [*rows, ("wake along its axis", "uniform: one plane, extruded")]
    text = f"{closing.how}: a period of {closing.period:.4g} m, repeated"
    rows.append(("wake along its axis", text))
    if closing.changed:
        # a mirror leaves the flow in the planes across the axis
        kept = "as in the file"
        if closing.how == "blend":
            changed = np.isin(np.arange(len(strength[0])), closing.changed)
            ratios = [float(one[changed].mean() / one[~changed].mean()) for one in strength]
            kept = f"{max(abs(ratio - 1) for ratio in ratios):.1%} off that elsewhere"
        text = (
            f"changed over {encounter.wake.ends_length:g} m: divergence {closing.divergence:.2g} "
            f"of the gradients there ({closing.divergence_before:.2g} in the file), circulation "
            f"{kept}"
        )
        rows.append(("ends of the volume", text))
    return rows


_OUTER = (15.0, 12.0, 10.0, 8.0)
"""Outer radius of the rings over which circulation and drift of a vortex are averaged, m."""

Section = tuple[Core, float]
"""A core in a plane of a volume, and its circulation from 5 m to 15 m or less, m^2 s^-1."""


Sides = tuple[list[Section], list[Section]]
"""Port and starboard."""


# check, flight and report need it again: cores in every plane take seconds to find
@lru_cache(maxsize=2)
def _volume(
    path: Path, stamp: int, keys: str, ends: Ends, length: float
) -> tuple[xr.Dataset, Sides, tuple[float, float], Closing]:
    """One period of a file's wake with its extinction, its cores by plane, its drift, its ends."""
    wake = Wake.model_validate_json(keys)
    needed, names = tracers_of(wake)
    plane = wake.x if wake.depth == "plane" else None
    flow = read_wake(path, wake.time, names, plane, require=needed)
    if wake.depth == "plane" and flow.sizes["x"] > 1:
        raise InputError(
            f"wake.x: missing; {path.name} has {flow.sizes['x']} planes, expected one of "
            f"{float(flow['x'][0]):g} to {float(flow['x'][-1]):g} m (or wake.depth: volume)"
        )
    flow, closing = one_period(flow, ends, length)
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
    return flow, sides, (float(v), float(w)), closing


def _rings(section: xr.Dataset, core: Core, partner: Core) -> Rings | None:
    """Averages over the widest rings within the plane and around no other core."""
    tried = (ring_averages(section, core, [partner], outer=outer) for outer in _OUTER)
    return next((rings for rings in tried if rings is not None), None)


def _vortex(core: Core, circulation: float) -> Vortex:
    return Vortex(circulation, core.radius, core.y, core.z)
