"""A lidar whose scanner is told a wrong attitude. Physics tier.

Detects: an error of the wrong sign or lever, a wake that is not seen elsewhere by range x angle, a
wind that is not feigned by range x change of angle / time, stated errors that leave it out, errors
of places or times taken without a word.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.encounter.lidar.pointing import pointing_error
from lidar_mi.errors import InputError
from tests.support.encounters import small_encounter

RANGE = 150 + 1.25  # middle of the farther gate


def departure(**reported):
    """By how much the pair of the first slab differs by an error, with 4 standard errors."""
    found = []
    for told in (reported, None):
        lidar = lm.VirtualLidar(small_encounter(platform={"reported": told}))
        lidar.step(0.0)
        found.append(lidar.step(0.1).pair)
    wrong, right = found
    spread = np.sqrt(np.diagonal(wrong.covariance) + np.diagonal(right.covariance))
    return wrong.parameters - right.parameters, 4 * spread


@pytest.mark.slow
def test_a_nose_that_is_higher_than_told_sees_the_wake_lower():
    """By range x angle; the lever shrinks by the distance flown, which feigns a wind V x angle."""
    angle = 20e-3
    for axis, places, mean in (("pitch", (3, 7), 9), ("yaw", (2, 6), 8)):
        found, error = departure(offset={axis: f"{angle} rad"})
        for k in places:
            # in the middle between both scans
            assert found[k] == pytest.approx(-(RANGE - 3.75) * angle, abs=error[k])
            assert error[k] < 0.5 * RANGE * angle
        assert found[mean] == pytest.approx(75 * angle, abs=error[mean])


def test_a_roll_turns_the_pair():
    """Vortices 24 m apart: the port wing higher than told, and the port vortex seems lower."""
    angle = 200e-3
    found, error = departure(offset={"roll": f"{angle} rad"})
    spread = np.hypot(error[3], error[7])
    assert found[3] - found[7] == pytest.approx(-24 * angle, abs=spread) and spread < 2


def test_change_from_scan_to_scan_feigns_a_wind():
    """5 mrad/s from the first scan on: the nearer gate is 144 m x 0.5 mrad lower after 0.1 s."""
    found, error = departure(drift={"pitch": "5 mrad/s"})
    assert found[9] == pytest.approx(-(RANGE - 7.5) * 5e-3, abs=error[9])
    # half of it is by the turbulence that the wind around the pair may have
    assert error[9] < 1.3


def test_random_errors_are_those_of_the_navigation_unit():
    reported = {"noise": {"pitch": "1 mrad"}, "offset": {"yaw": "2 mrad"}}
    experiment = small_encounter(platform={"reported": reported})
    turned = [pointing_error(experiment, number, 0.1 * number) for number in range(400)]
    yaw, pitch, roll = np.array([one.as_euler("ZYX") for one in turned]).T
    assert np.abs(yaw - 2e-3).max() < 1e-5 and np.abs(roll).max() < 1e-5
    # of a chi-square of 400 degrees of freedom, 4 sigma
    assert pitch.var() == pytest.approx(1e-6, rel=4 * np.sqrt(2 / 400))
    assert abs(np.corrcoef(pitch[:-1], pitch[1:])[0, 1]) < 4 / np.sqrt(399)


@pytest.mark.parametrize(
    ("reported", "key"),
    [
        ({"offset": {"y": "1 m"}}, "platform.reported.offset.y: 1 is not allowed"),
        ({"drift": {"x": "1 m/s"}}, "platform.reported.drift.x: 1 is not allowed"),
        ({"latency": "5 ms"}, "platform.reported.latency: 0.005 is not allowed"),
        ({"noise": {"yaw": "0.1 mrad"}, "noise_bandwidth": "3 Hz"}, "bandwidth: 3 is not allowed"),
    ],
)
def test_errors_that_flights_do_not_have_are_refused(reported, key):
    with pytest.raises(InputError, match=key):
        lm.VirtualLidar(small_encounter(platform={"reported": reported}))
