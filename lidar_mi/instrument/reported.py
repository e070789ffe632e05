"""The reported pose of the platform: the truth, late and with the errors of a navigation unit.

Errors are truth minus the reported value, in the lidar's frame.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
from pydantic import Field

from lidar_mi.description import Description
from lidar_mi.instrument.motion import ANGLES, PLACES, Pose, attitude, random_process
from lidar_mi.units import Angle, AngularRate, Frequency, Length, Speed, Time, Within

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_Place = Annotated[Length, Within(-10000, 10000, "no navigation at all")]
_Turn = Annotated[Angle, Within(-1, 1, "larger errors are no errors of an attitude")]
_PlaceRate = Annotated[Speed, Within(-1000, 1000, "no navigation at all")]
_TurnRate = Annotated[AngularRate, Within(-10, 10, "no gyroscope at all")]
_PlaceRms = Annotated[Length, Within(0, 10000, "no navigation at all")]
_TurnRms = Annotated[Angle, Within(0, 0.3, "larger errors are no errors of an attitude")]


class Offset(Description):
    """Constant errors."""

    x: _Place = 0.0
    y: _Place = 0.0
    z: _Place = 0.0
    roll: _Turn = 0.0
    pitch: _Turn = 0.0
    yaw: _Turn = 0.0


class Drift(Description):
    """Errors that grow with time, from 0 at the first scan."""

    x: _PlaceRate = 0.0
    y: _PlaceRate = 0.0
    z: _PlaceRate = 0.0
    roll: _TurnRate = 0.0
    pitch: _TurnRate = 0.0
    yaw: _TurnRate = 0.0


class Noise(Description):
    """Rms of random errors."""

    x: _PlaceRms = 0.0
    y: _PlaceRms = 0.0
    z: _PlaceRms = 0.0
    roll: _TurnRms = 0.0
    pitch: _TurnRms = 0.0
    yaw: _TurnRms = 0.0


class Reported(Description):
    """How the reported pose differs from the true one; nothing: not at all."""

    offset: Offset = Offset()
    drift: Drift = Drift()
    noise: Noise = Noise()
    noise_bandwidth: (
        Annotated[Frequency, Within(1e-6, 1e6, "from a day's drift to a sample each beam")] | None
    ) = Field(None, description="of the noise; default: one error for all of a scan")
    latency: Annotated[Time, Within(0, 10, "the slowest display")] = Field(
        0.0, description="age of what is reported"
    )


def reported_pose(
    reported: Reported,
    pose_at: Callable[[np.ndarray], Pose],
    time: np.ndarray,
    speed: float,
    seed: int,
    scan: int,
) -> Pose:
    """The pose that is reported at times since the first scan.

    Parameters
    ----------
    reported : Reported
    pose_at : callable
        The true pose at times, (n,), s.
    time : (n,) array
        s.
    speed : float
        Of straight flight, m/s.
    seed : int
        Of the experiment.
    scan : int
        Number of the scan, which has a random error of its own unless noise has a bandwidth.
    """
    late = pose_at(time - reported.latency)
    error = {}
    for number, axis in enumerate((*PLACES, *ANGLES)):
        offset, drift, rms = (
            getattr(part, axis) for part in (reported.offset, reported.drift, reported.noise)
        )
        error[axis] = offset + drift * time
        if rms and reported.noise_bandwidth is not None:
            random = np.random.default_rng([seed, 3, 2, number + 1])
            error[axis] += random_process(time, rms, reported.noise_bandwidth, random)
        elif rms:
            random = np.random.default_rng([seed, 3, 3, scan + 1, number + 1])
            error[axis] += rms * random.standard_normal()
    # errors are truth less report
    place = late.place - np.stack([error[axis] for axis in PLACES], -1)
    # departures are from where straight flight is now, not at the age of the report
    place[:, 0] -= speed * reported.latency
    velocity = late.velocity - [getattr(reported.drift, axis) for axis in PLACES]
    missed = attitude(*(error[axis] for axis in ANGLES))
    return Pose(place, velocity, cast("Rotation", missed.inv() * late.attitude))
