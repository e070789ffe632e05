"""The Doppler lidar of a flight.

Detects: lines at another time or place than half way between two scans of the slab, a velocity of
the aircraft that is left out, an attitude that is told wrong without an effect, lidars that look at
different slabs, and settings without a meaning in flight that are taken silently.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.encounter.lidar.doppler import Midway, at_the_slabs, doppler_scans
from lidar_mi.encounter.lidar.slabs import gates_of
from lidar_mi.errors import InputError
from tests.support.encounters import both_lidars, small_encounter


class Shear:
    """A wind that changes with place and time, by hand."""

    def wind(self, x, y, z, time):
        return 0.01 * (x - 100) + 2 * time, 0.1 * y, -0.05 * z + 1.0


@pytest.fixture(scope="module")
def scans():
    experiment = both_lidars()
    return doppler_scans(experiment, gates_of(experiment))


MIDWAY = Midway(np.array([10.0, 2.0, -3.0]), np.array([75.0, 1.0, -2.0]))


def expected(scans, midway, x, time, going, told):
    """The wind at the middles of the bins and the aircraft's velocity along the lines."""
    away = (x - midway.place[0]) / told[:, :1] * going
    place = midway.place + away
    wind = np.stack(Shear().wind(*place.T, time), -1)
    return ((midway.velocity - wind) * going).sum(1)


@pytest.mark.parametrize("turned", [None, Rotation.from_euler("z", 2, degrees=True)])
def test_speeds_are_those_of_place_time_and_motion(scans, turned):
    """The wind is linear, so that its mean over a bin is that at its centroid, 0.1 m nearer."""
    found = scans.frames(Shear(), 3, 160.0, 1.5, MIDWAY, turned).lines
    told = scans.experiment.sensor.directions.directions()
    going = told if turned is None else turned.apply(told)
    true = expected(scans, MIDWAY, 160.0, 1.5, going, told)
    np.testing.assert_allclose(found["v_los_true"], true, atol=0.02)
    np.testing.assert_allclose(found["direction"].values, told)
    np.testing.assert_allclose(found["platform_velocity"].values, np.tile([75, 1, -2], (12, 1)))


def test_midway_is_between_two_poses():
    found = Midway.between(AircraftPose(0.0, 1.0), AircraftPose(7.5, 2.0, -1.0), 0.1)
    np.testing.assert_allclose(found.place, [3.75, 1.5, -0.5])
    np.testing.assert_allclose(found.velocity, [75, 10, -10])


def test_range_is_that_of_the_slab(scans):
    """Look-ahead of 150 m, less half of the 7.5 m between scans, and half a gate of 2.5 m."""
    assert scans.experiment.doppler.lidar.range == pytest.approx(147.5)


def test_without_a_sensor_there_is_none():
    experiment = small_encounter()
    assert doppler_scans(experiment, gates_of(experiment)) is None
    assert at_the_slabs(experiment, gates_of(experiment)) is experiment


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"doppler": {"lidar": {"range": "56 m"}}}, "doppler.lidar.range: 56 m is not allowed"),
        ({"sensor": {"timing": {"duration": "50 ms"}}}, "sensor.timing: not allowed"),
        (
            {
                "path": {"speed": "149 m/s"},
                "doppler": {"etalon": {"gap": "80 mm"}, "v_los": ["0 m/s"]},
            },
            "encounter.path.speed: 149 m/s is not allowed",
        ),
    ],
)
def test_what_has_no_meaning_in_flight_is_refused(changes, named):
    experiment = both_lidars(**changes)
    with pytest.raises(InputError, match=named):
        doppler_scans(experiment, gates_of(experiment))
