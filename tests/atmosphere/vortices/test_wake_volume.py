"""Volumes repeated along a wake's axis, against the analytic wake that they were sampled from.

Physics tier. Detects: a wrong turn or place of the volume, a seam, a period that is off by a plane,
an exhaust that moves otherwise than the wake.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.atmosphere.vortices.wake_period import one_period
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from tests.support.wake_volumes import SEPARATION, crow_volume

PAIR = PairAlongPath(
    300.0,
    SEPARATION,
    crossing_angle=math.radians(25),
    climb_angle=math.radians(-3),
    x_c=600.0,
    t_c=8.0,
    miss=(4.0, -3.0),
    crow_amplitude=3.0,
)


def placed(flow, pair):
    """The volume where the pair is, with the vortices that the pair has in the volume's planes."""
    straight = replace(pair, crossing_angle=0.0, climb_angle=0.0, x_c=0.0, t_c=0.0, miss=(0.0, 0.0))
    sections = [straight.vortices(x, 0.0) for x in flow["x"].values]
    # the pair's descent, from the height at which it is a second before
    descent = -float(straight.centre_at(-1.0)[2])
    return VolumeAlongPath(
        flow,
        *zip(*sections, strict=True),
        background=1e-4,
        drift=(0.0, descent),
        origin=(0.0, 0.0, 0.0),
        crossing_angle=pair.crossing_angle,
        climb_angle=pair.climb_angle,
        x_c=pair.x_c,
        t_c=pair.t_c,
        miss=pair.miss,
    )


@pytest.fixture(scope="module")
def volume():
    return placed(crow_volume(waves=1, amplitude=3.0), PAIR)


@pytest.mark.parametrize("when", [8.0, 6.5])
def test_wind_of_many_periods_is_that_of_the_analytic_pair(volume, when):
    """Within 1 % of the largest swirl, the splines' error at 1 m nodes in a core of 3 m."""
    random = np.random.default_rng(2)
    along = random.uniform(-700, 700, 3000)  # seven periods
    across, up = random.uniform(-28, 28, (2, 3000)) * [[1.0], [0.6]]
    centre = np.array(PAIR.centre_at(when))[:, None]
    places = centre + sum(
        a[:, None] * b for a, b in zip(PAIR.axes, (along, across, up), strict=True)
    )
    expected, found = (np.array(one.wind(*places, when)) for one in (PAIR, volume))
    fastest = np.abs(expected).max()
    assert np.abs(found - expected).max() < 0.01 * fastest
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.001 * fastest


def test_vortices_in_planes_across_the_path(volume):
    for x in (300.0, 600.0, 655.5, 1200.0):
        for found, expected in zip(volume.vortices(x, 7.0), PAIR.vortices(x, 7.0), strict=True):
            assert found.y == pytest.approx(expected.y, abs=0.02)
            assert found.z == pytest.approx(expected.z, abs=0.02)
            assert found.circulation == pytest.approx(expected.circulation, rel=1e-6)
            assert found.core_radius == pytest.approx(expected.core_radius, rel=1e-2)


def test_exhaust_moves_with_the_wake(volume):
    """The volume's exhaust lies about its cores: so it does in planes across the path."""
    for when in (8.0, 6.0):
        for vortex in volume.vortices(620.0, when):
            inside = volume.extinction(620.0, vortex.y, vortex.z, when)
            beside = volume.extinction(620.0, vortex.y, vortex.z + 12.0, when)
            assert inside > 1.5e-3 > 3e-4 > beside
    assert volume.extinction(600.0, 0.0, 500.0, 8.0) == 1e-4


def test_wind_outside_is_that_of_a_straight_pair(volume):
    straight = replace(PAIR, crow_amplitude=0.0)
    expected, found = (one.wind(600.0, [0.0, 90.0], [60.0, 0.0], 8.0) for one in (straight, volume))
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_a_plane_is_uniform_along_the_wake():
    flow = crow_volume(waves=1, amplitude=0.0).isel(x=[0])
    straight = replace(PAIR, crow_amplitude=0.0)
    wake = placed(one_period(flow)[0], straight)
    place = np.array([[600.0, 400.0], [10.0, -80.0], [5.0, 8.0]])
    np.testing.assert_allclose(wake.wind(*place, 8.0), straight.wind(*place, 8.0), atol=0.02)
    assert wake.vortices(400.0, 8.0)[0].y == pytest.approx(straight.vortices(400.0, 8.0)[0].y)
