"""Pointing of the lidar of a flight whose reported attitude has errors."""

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_mi.errors import InputError
from lidar_mi.instrument.motion import PLACES, Pose
from lidar_mi.instrument.reported import Reported, reported_pose
from lidar_mi.schema.experiment import Experiment


def pointing_error(experiment: Experiment, number: int, time: float) -> Rotation | None:
    """True attitude of the lidar in a scan, relative to the one by which its beams are aimed.

    The scanner compensates the attitude that is reported. Its error is that of
    `lidar_mi.instrument.reported.reported_pose`, one draw a scan.

    Returns
    -------
    Rotation or None
        None where the reported attitude is the true one.
    """
    reported = experiment.platform.reported
    if reported is None:
        return None
    level = Pose(np.zeros((1, 3)), np.zeros((1, 3)), Rotation.identity(1))
    pose = reported_pose(reported, lambda _: level, np.array([time]), 0.0, experiment.seed, number)
    # the scanner turns the beams against the reported attitude
    return pose.attitude[0].inv()


def check_reported(reported: Reported | None) -> None:
    """Refuse errors without effect in flight, where only the reported attitude has errors.

    The places of wake and aircraft have the same error, which cancels.

    Raises InputError: errors of the place, a bandwidth, a latency.
    """
    if reported is None:
        return
    for name in ("offset", "drift", "noise"):
        for axis in PLACES:
            value = getattr(getattr(reported, name), axis)
            if value:
                raise InputError(
                    f"platform.reported.{name}.{axis}: {value:g} is not allowed in an encounter, "
                    "where the aircraft steers by what it sees from its own place; expected 0"
                )
    for key, given, expected in (
        ("noise_bandwidth", reported.noise_bandwidth, None),
        ("latency", reported.latency, 0.0),
    ):
        if given != expected:
            raise InputError(
                f"platform.reported.{key}: {given:g} is not allowed in an encounter; expected "
                f"{expected}, one error a scan"
            )
