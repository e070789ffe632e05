"""The sum of a wake and other air. Physics tier.

Detects: air in the frame of the path that climbs instead of the level one, a wake that stays while
the air about it moves, cores elsewhere than their swirl, divergence of the sum.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidar_mi.atmosphere.air.along_path import AirAlongPath, LevelFrame
from lidar_mi.atmosphere.air.gust import Gust
from lidar_mi.atmosphere.air.microburst import Microburst
from lidar_mi.atmosphere.air.shear import LinearShear
from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.errors import InputError

CLIMB = math.radians(-3)
FRAME = LevelFrame(300.0, CLIMB)
PAIR = PairAlongPath(300.0, crossing_angle=0.2, climb_angle=CLIMB, x_c=400.0, t_c=5.0)


def test_a_level_wind_in_the_frame_of_the_path():
    """A path that falls by 3 degrees is pitched: by scipy's rotation about y (nose down is +)."""
    to_level = Rotation.from_euler("y", -CLIMB)
    places = np.random.default_rng(1).uniform(-200, 200, (50, 3))
    level = np.add(to_level.apply(places), [0, 0, 300])
    burst = Microburst(15.0, 300.0, 60.0, 20.0)
    expected = to_level.inv().apply(np.stack(burst.velocity(*level.T, 0.0), axis=-1))
    found = AirAlongPath(None, (burst,), FRAME).wind(*places.T, 0.0)
    np.testing.assert_allclose(np.stack(found, axis=-1), expected, atol=1e-10)


def test_heights_of_a_path():
    """Along a path that falls by 3 degrees the height is less by 5.2 % of the way."""
    x, height = FRAME.places(1000.0, 0.0)
    assert (float(x), float(height)) == pytest.approx((998.63, 300 - 52.336), abs=0.01)


def test_the_sum():
    parts = (LinearShear(0.02, 0.05, 300.0), Gust("up", 50.0, 350.0, 9.0))
    air = AirAlongPath(PAIR, parts, FRAME, t_c=5.0)
    at = (np.linspace(300, 500, 9), 3.0, -2.0, 4.0)
    own, other = PAIR.wind(*at), AirAlongPath(None, parts, FRAME).wind(*at)
    np.testing.assert_allclose(air.wind(*at), np.add(own, other), rtol=1e-12)
    assert air.vortices(390.0, 4.0) == PAIR.vortices(390.0, 4.0)
    assert air.extinction(*at) is None


def test_the_wake_drifts():
    """Its swirl and its cores; at t_c it is where it is without the drift."""
    drift = (1.5, -4.0, 3.0)
    air = AirAlongPath(PAIR, (), FRAME, drift, t_c=5.0)
    assert air.vortices(400.0, 5.0) == PAIR.vortices(400.0, 5.0)
    for time in (2.0, 6.5):
        port, _ = air.vortices(420.0, time)
        still, _ = PAIR.vortices(420.0 - 1.5 * (time - 5), time)
        assert (port.y, port.z) == pytest.approx(
            (still.y - 4 * (time - 5), still.z + 3 * (time - 5))
        )
        # at the core there is the partner's wind alone
        speed = np.linalg.norm(air.wind(420.0, port.y, port.z, time))
        assert speed == pytest.approx(300 / (2 * np.pi * 47.1), rel=0.02)


def test_no_divergence():
    parts = (
        turbulence(1.5, 200.0, 1, shortest=20.0),
        LinearShear(0.02, 0.05, 300.0),
        Gust("up", 50.0, 350.0, 9.0),
        Microburst(15.0, 300.0, 60.0, 420.0),
    )
    air = AirAlongPath(PAIR, parts, FRAME, (1.0, 2.0, 3.0), 5.0)
    places, h = np.random.default_rng(2).uniform(-60, 60, (3, 300)), 0.1
    places[0] += 400
    gradient = np.empty((3, 3, 300))
    for axis in range(3):
        shift = h * np.eye(3)[axis][:, None]
        ahead, behind = (air.wind(*(places + sign * shift), 4.0) for sign in (1, -1))
        gradient[axis] = np.subtract(ahead, behind) / (2 * h)
    size = np.sqrt((gradient**2).sum((0, 1)).mean())
    assert np.abs(np.einsum("iin->n", gradient)).max() < 5e-3 * size


def test_without_a_wake_there_are_no_vortices():
    with pytest.raises(InputError, match=r"encounter\.air\.wake: false leaves no vortices"):
        AirAlongPath(None, (), FRAME).vortices(0.0, 0.0)
