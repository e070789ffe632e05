"""Where the aircraft is and how it is turned."""

from dataclasses import dataclass, fields

import numpy as np

from lidar_mi.errors import InputError


@dataclass(frozen=True)
class AircraftPose:
    """Place and attitude of the aircraft in the path frame.

    The telescope is at the aircraft's place. The scanner compensates the attitude, so that it does
    not change where beams go.

    Attributes
    ----------
    x, y, z : float
        m: along the path, to the left, up.
    roll, pitch, yaw : float
        rad: port wing up, nose up, nose to port.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> lm.AircraftPose(x=75.0, y=0.5, roll=0.1).z
    0.0
    """

    x: float
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not np.isfinite(value):
                raise InputError(
                    f"pose.{field.name}: {value} is not allowed; expected a finite number"
                )
