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

    x: _Place = Field(0.0, description="constant error")
    y: _Place = Field(0.0, description="constant error")
    z: _Place = Field(0.0, description="constant error")
    roll: _Turn = Field(0.0, description="constant error")
    pitch: _Turn = Field(0.0, description="constant error")
    yaw: _Turn = Field(0.0, description="constant error")


class Drift(Description):
    """Errors that grow with time, from 0 at the first scan."""

    x: _PlaceRate = Field(0.0, description="error per second since the first scan")
    y: _PlaceRate = Field(0.0, description="error per second since the first scan")
    z: _PlaceRate = Field(0.0, description="error per second since the first scan")
    roll: _TurnRate = Field(0.0, description="error per second since the first scan")
    pitch: _TurnRate = Field(0.0, description="error per second since the first scan")
    yaw: _TurnRate = Field(0.0, description="error per second since the first scan")


class Noise(Description):
    """Rms of random errors."""

    x: _PlaceRms = Field(0.0, description="rms of the random error")
    y: _PlaceRms = Field(0.0, description="rms of the random error")
    z: _PlaceRms = Field(0.0, description="rms of the random error")
    roll: _TurnRms = Field(0.0, description="rms of the random error")
    pitch: _TurnRms = Field(0.0, description="rms of the random error")
    yaw: _TurnRms = Field(0.0, description="rms of the random error")


class Reported(Description):
    """How the reported pose differs from the true one; nothing: not at all."""

    offset: Offset = Offset()
    drift: Drift = Drift()
    noise: Noise = Noise()
    noise_bandwidth: (
        Annotated[Frequency, Within(1e-6, 1e6, "from a day's drift to a sample each beam")] | None
    ) = Field(
        None,
        description="of the noise; default: one error for all beams of a scan, another for the "
        "next",
    )
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

    pose_at: the true pose at times, (n,), s.
    time (n,): s.
    speed: of straight flight, m/s.
    seed: of the experiment.
    scan: number of the scan, which has a random error of its own unless noise has a bandwidth.
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
