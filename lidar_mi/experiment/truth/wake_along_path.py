"""The wake of an encounter along the flight path."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.atmosphere.vortices.wake_period import Closing, Ends, one_period
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.aged_wake import analytic_wake, described_pair
from lidar_mi.experiment.truth.file_wake import (
    Pairs,
    pairs_in,
    read_planes,
    refuse_ages,
    with_extinction,
)
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.wake import Wake


def encounter_of(experiment: Experiment) -> Encounter:
    """The encounter of an experiment."""
    if experiment.encounter is None:
        raise InputError(
            f"encounter: missing in {experiment.name}; expected the section of a flight through "
            "the wake"
        )
    return experiment.encounter


def wake_along_path(experiment: Experiment) -> WakeAlongPath:
    """Wind and vortices along the flight path.

    Raises InputError: no encounter, or a wake that is not known along its axis.
    """
    encounter, wake = encounter_of(experiment), experiment.wake
    if wake is not None and wake.file:
        return _from_file(wake, wake.file, encounter, experiment.folder)
    if wake is None or wake.vortex_pair is None:
        source = "nothing" if wake is None else "turbine"
        raise InputError(
            f"wake: {source} is not allowed in an encounter, as it is not known along the wake's "
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
    aged = encounter.wake
    refuse_ages(
        "encounter.wake",
        {
            "age": aged.age,
            "decay_time": aged.decay_time,
            "dissipation_rate": aged.dissipation_rate,
            "crow.amplitude": aged.crow.amplitude,
        },
    )
    flow, (port, starboard), drift, _ = _period_of(wake, file, encounter, folder)
    vortices = [*port, *starboard]
    middle = np.mean([vortex.y for vortex in vortices]), np.mean([vortex.z for vortex in vortices])
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
) -> tuple[xr.Dataset, Pairs, tuple[float, float], Closing]:
    path = find_file(file, folder, "wake.file")
    # the modification time: a changed file is read again
    stamp, ends = path.stat().st_mtime_ns, encounter.wake
    return _volume(path, stamp, wake.model_dump_json(), ends.ends, ends.ends_length)


def described_wake(experiment: Experiment) -> list[tuple[str, str]]:
    """The wake of an encounter, if any, in words: a name and a line for each property."""
    encounter, wake = encounter_of(experiment), experiment.wake
    if encounter.air is not None and not encounter.air.wake:
        return []
    if wake is not None and wake.vortex_pair is not None:
        return described_pair(wake.vortex_pair, encounter)
    along = wake_along_path(experiment)
    assert wake is not None and wake.file and isinstance(along, VolumeAlongPath)
    _, sides, _, closing = _period_of(wake, wake.file, encounter, experiment.folder)
    strength = [np.array([abs(vortex.circulation) for vortex in side]) for side in sides]
    mean = float(np.mean(strength))
    rows = [("vortices when met", f"{mean:.4g} m^2/s, of {wake.file}, frozen in this state")]
    if closing.how == "uniform":
        return [*rows, ("wake along its axis", "uniform: one plane, extruded")]
    text = f"{closing.how}: a period of {closing.period:.4g} m, repeated"
    rows.append(("wake along its axis", text))
    if closing.changed:
        # a mirror does not change the flow in planes across the axis
        change = "as in the file"
        if closing.how == "blend":
            changed = np.isin(np.arange(len(strength[0])), closing.changed)
            ratios = [float(gamma[changed].mean() / gamma[~changed].mean()) for gamma in strength]
            change = f"{max(abs(ratio - 1) for ratio in ratios):.1%} off that elsewhere"
        text = (
            f"changed over {encounter.wake.ends_length:g} m: divergence {closing.divergence:.2g} "
            f"of the gradients there ({closing.divergence_before:.2g} in the file), circulation "
            f"{change}"
        )
        rows.append(("ends of the volume", text))
    return rows


# check, flight and report need it again: cores in every plane take seconds to find
@lru_cache(maxsize=2)
def _volume(
    path: Path, stamp: int, keys: str, ends: Ends, length: float
) -> tuple[xr.Dataset, Pairs, tuple[float, float], Closing]:
    """One period of a file's wake with its extinction, its vortices, its drift, its ends."""
    wake = Wake.model_validate_json(keys)
    flow = read_planes(path, wake, volume=wake.depth == "volume")
    flow, closing = one_period(flow, ends, length)
    flow = with_extinction(flow, wake)
    return flow, *pairs_in(flow, path.name), closing
