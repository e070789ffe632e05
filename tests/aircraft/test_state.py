"""Loads on an aircraft in a wind of the path frame, and controls within their limits.

Detects a wrong sense of roll or yaw, a place or time not handed on, a limit exceeded, a path below
the ground.
"""

import numpy as np
import pytest

from lidar_mi.aircraft.state import AircraftState, Commands, Limits, deflected, loads_in_wind
from lidar_mi.aircraft.strips import fin_strips, wing_strips
from lidar_mi.errors import InputError
from lidar_mi.schema.reading import load_experiment

WING = wing_strips(28.9, 108.8, 5.3)


def test_wind_is_asked_where_and_when_the_wing_is():
    asked = {}

    def wind(x, y, z, time):
        asked.update(x=x, y=y, z=z, time=time)
        return 0 * x, 0 * x, 0 * x + 1.0

    state = AircraftState(time=2.0, x=150.0, y=-3.0, z=5.0, roll=np.pi / 2)
    loads_in_wind(WING, state, wind, 1.2)
    # the port wing points up
    np.testing.assert_allclose(asked["z"], 5 + WING.places[:, 1])
    np.testing.assert_allclose(asked["y"], -3, atol=1e-9)
    np.testing.assert_allclose(asked["x"], 150)
    assert asked["time"] == 2.0


def test_wind_is_turned_into_the_body():
    """Rolled by 90 degrees, the wing's normal points to starboard."""
    state = AircraftState(roll=np.pi / 2)
    upwards = loads_in_wind(WING, state, lambda x, y, z, t: (0 * x, 0 * x, 0 * x + 1), 1.2)
    starboard = loads_in_wind(WING, state, lambda x, y, z, t: (0 * x, 0 * x - 1, 0 * x), 1.2)
    assert upwards.force[2] == pytest.approx(0, abs=1e-6) and starboard.force[2] > 0


def test_nose_to_port_meets_a_headwind_from_starboard():
    """Yawed by 10 degrees, a tailwind of 10 m/s blows 10 sin(10 deg) to starboard."""
    fin = fin_strips(6.0, 27.0, 5.3)
    state = AircraftState(yaw=np.radians(10))
    along = loads_in_wind(fin, state, lambda x, y, z, t: (0 * x + 10, 0 * x, 0 * x), 1.2)
    across = loads_in_wind(fin, AircraftState(), lambda x, y, z, t: (0 * x, 0 * x + 1, 0 * x), 1.2)
    assert along.force[1] == pytest.approx(-10 * np.sin(np.radians(10)) * across.force[1])


def test_flies_on_with_its_attitude():
    """Loads at several times are those of states that have moved on along their course."""

    def wind(x, y, z, time):
        return 0 * x + y, 0.1 * x + z, np.sin(x / 20) + 0.2 * time * y

    state = AircraftState(time=1.0, x=10.0, y=2.0, roll=0.1, roll_rate=0.5, airspeed=75.0)
    ahead = loads_in_wind(WING, state, wind, 1.2, [1.0, 1.5, 2.25])
    assert ahead.force.shape == ahead.moment.shape == (3, 3)
    for k, (time, x) in enumerate(((1.0, 10.0), (1.5, 47.5), (2.25, 103.75))):
        there = AircraftState(time=time, x=x, y=2.0, roll=0.1)
        loads = loads_in_wind(WING, there, wind, 1.2)
        np.testing.assert_allclose(ahead.force[k], loads.force, rtol=1e-12)
        np.testing.assert_allclose(ahead.moment[k], loads.moment, rtol=1e-12, atol=1e-6)


def test_controls_move_at_their_rate_within_their_limits():
    limits = Limits(np.array([0.3, 0.2, 0.0]), np.array([1.0, 0.5, 0.0]))
    after, moving = deflected(np.zeros(3), Commands(5.0, -0.01, 1.0), 0.1, limits)
    np.testing.assert_allclose(after, [0.1, -0.01, 0.0])
    np.testing.assert_allclose(moving, [0.1, 0.02, 0.0])
    for _ in range(9):
        after, moving = deflected(after, Commands(5.0, -0.01, 1.0), 0.1, limits)
    np.testing.assert_allclose(after, [0.3, -0.01, 0.0])
    np.testing.assert_allclose(moving, 0)


def test_the_name_of_an_aircraft_may_be_a_number():
    changed = load_experiment("wake_backscatter", **{"encounter.aircraft.model": 737})
    assert changed.encounter.aircraft.model == "737"


def test_a_path_through_the_ground_is_refused():
    with pytest.raises(InputError, match=r"encounter\.path: .*27 m below the ground.*above 47 m"):
        load_experiment("wake_backscatter", **{"encounter.path.altitude": "20 m"})
