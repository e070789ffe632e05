"""What wrong poses make of the wind, against closed forms.

Detects: a wrong sign or factor of a shift or a turn between the scans, an apparent wind from errors
that both scans share, a rotation that is mistaken for strain.
"""

import numpy as np
import pytest

from lidar_mi.assessment.metrics.pointing import (
    apparent_wind,
    common_motion,
    pointing_metrics,
    scan_pointing,
)

Y, Z, DT, RANGE = np.linspace(-20, 20, 9), np.linspace(-10, 10, 5), 0.1, 150.0
NODES = np.stack([part.ravel() for part in np.meshgrid(Y[::-1], Z[::-1])], -1)


def scans(first, second):
    """Beams reported at the nodes whose true places are these functions of them."""
    time = np.linspace(-0.04, 0.04, len(NODES))
    return scan_pointing(Y, Z, DT, [time] * 2, [f(NODES) for f in (first, second)], [NODES] * 2)


def test_a_yaw_between_the_scans_is_range_times_angle_over_time():
    """Beams that go 1 mrad too far to port meet air too far to port: it seems to move starboard."""
    found = scans(lambda p: p, lambda p: p + np.array([RANGE * 1e-3, 0]))
    np.testing.assert_allclose(apparent_wind(found), np.tile([-1.5, 0.0], (len(NODES), 1)))
    (v, w), rotation = common_motion(found)
    assert (v, w, rotation) == pytest.approx((-1.5, 0, 0), abs=1e-9)
    assert found.on_nodes() and pointing_metrics(found)["pointing.scan_time"] == pytest.approx(0.08)


def test_a_roll_between_the_scans_is_a_rotation_against_it():
    roll = 2e-3
    found = scans(lambda p: p, lambda p: p + roll * np.stack([-p[:, 1], p[:, 0]], -1))
    (v, w), rotation = common_motion(found)
    assert (v, w) == pytest.approx((0, 0), abs=1e-9)
    assert rotation == pytest.approx(-roll / DT)
    strained = scans(lambda p: p, lambda p: p + roll * np.stack([p[:, 1], p[:, 0]], -1))
    assert common_motion(strained)[1] == pytest.approx(0, abs=1e-12)


def test_errors_of_both_scans_add_no_wind():
    def off(places):
        return 1.01 * places + np.array([0.3, -0.2])

    found = scans(off, off)
    assert np.abs(apparent_wind(found)).max() < 1e-12
    numbers = pointing_metrics(found)
    assert numbers["pointing.bias_v"] == pytest.approx(0, abs=1e-9)
    assert numbers["pointing.rms_y"] > 0.3
    assert pointing_metrics(None) == {}
