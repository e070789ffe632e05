"""The aircraft's pose. Unit tier. Detects a value that is not a number and is let through."""

import math

import pytest

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.errors import InputError


def test_values_that_are_not_finite_are_named():
    assert AircraftPose(3.0).yaw == 0
    for name in ("x", "z", "roll"):
        with pytest.raises(InputError, match=f"pose.{name}: nan"):
            AircraftPose(**({"x": 0.0} | {name: math.nan}))
