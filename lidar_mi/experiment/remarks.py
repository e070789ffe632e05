"""Warnings before a run starts: of what is allowed and likely wrong."""

from collections.abc import Mapping
from typing import Any

from lidar_mi.assessment.metrics.cores import find_cores
from lidar_mi.assessment.metrics.flow_checks import MOST_DIVERGENCE, relative_divergence, rises
from lidar_mi.experiment.light_budget import LEAST_OVERLAP, light_budget
from lidar_mi.experiment.schema import Experiment


def remarks(experiment: Experiment, ahead: Mapping[str, Any]) -> list[str]:
    """Warnings of an experiment, a line each.

    Parameters
    ----------
    ahead : mapping
        Results of the stages that are computed ahead, by name.
    """
    return [*_of_the_flow(experiment, ahead), *_of_the_light(experiment, ahead)]


def _of_the_flow(experiment: Experiment, ahead: Mapping[str, Any]) -> list[str]:
    """Components or axes of the wrong sign in a user's file; analytic flows have none."""
    if experiment.wake is None or not experiment.wake.file:
        return []
    wind = ahead["truth"].wind
    divergence = relative_divergence(wind)
    if divergence > MOST_DIVERGENCE:
        return [
            f"wake.names: the divergence of v, w has {divergence:.2g} of the vorticity's rms, as "
            "if a component or an axis had the wrong sign; expected y to port, z up, v along y, w "
            "along z (a minus sign changes one: names: {v: -V})"
        ]
    if rises(find_cores(wind)):
        return [
            "wake.names: both vortices turn against the lift of an aircraft, and the pair rises; "
            "expected the port vortex (y > 0) to turn from +y towards +z (where z points "
            "down: names: {z: -Z, w: -W})"
        ]
    return []


def _of_the_light(experiment: Experiment, ahead: Mapping[str, Any]) -> list[str]:
    """Light that the telescope does not see."""
    if experiment.wake is None:
        return []
    light = light_budget(experiment, ahead["truth"], ahead["plans"][0], ahead["air"])
    if light.overlap >= LEAST_OVERLAP:
        return []
    field, distance = 1e3 * experiment.lidar.fov_half, ahead["plans"][0].centre
    return [
        f"lidar.fov_half: {field:.3g} mrad sees {light.overlap:.0%} of the light from "
        f"{distance:.0f} m (overlap of beam, telescope and field of view)"
    ]
