"""Beams of a scan: wrong places of true or reported beams in a plane of the air's frame."""

import numpy as np
import pytest

from lidar_mi.instrument.beams import Beams


def test_beams_cross_a_plane_at_range_times_tangent():
    angle = np.array([0.0, 0.1, -0.05])
    direction = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    origin = np.array([[0.0, 0.0, 0.0], [2.0, -1.0, 3.0], [-4.0, 0.5, 0.0]])
    ahead = np.broadcast_to([1.0, 0.0, 0.0], direction.shape)
    beams = Beams(np.zeros(3), origin, direction, np.zeros((3, 3)), ahead)
    distance = 500 - origin[:, 0]
    places = beams.true_places(500)
    assert places[:, 0] == pytest.approx(origin[:, 1] + distance * np.tan(angle))
    assert places[:, 1] == pytest.approx(origin[:, 2])
    assert np.array_equal(beams.reported_places(500), np.zeros((3, 2)))
