"""The wake of an encounter, as the flight meets it."""

from lidar_mi.atmosphere.wake_path import PairAlongPath, WakeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.schema_encounter import Encounter


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
    if wake is None or wake.vortex_pair is None:
        found = "nothing" if wake is None else wake.file or "turbine"
        raise InputError(
            f"wake: {found} is not allowed in an encounter, as it is not known along the wake's "
            "axis; expected wake.vortex_pair"
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
