"""Strips of wing, tail and fin.

Detects too few strips, any sign error, a wrong downwash. `validation.strips` has the moments on a
vortex's axis, the lifting line, lift and damping; tests/validation runs it.
"""

import numpy as np
import pytest

from lidar_mi.aircraft.strips import fin_strips, in_downwash, joined, wake_loads, wing_strips
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.errors import InputError

SPAN, AREA, SLOPE = 28.9, 108.8, 5.3
AIRSPEED, DENSITY = 75.0, 1.2
PRESSURE = 0.5 * DENSITY * AIRSPEED**2
ASPECT_RATIO = SPAN**2 / AREA


def wind(strips, vortices):
    """Wind of vortices along x at the strips."""
    v, w = velocity(vortices, strips.places[:, 1], strips.places[:, 2])
    return np.stack([np.zeros_like(v), v, w], -1)


def rolling_coefficient(model, core_radius, n):
    strips = wing_strips(SPAN, AREA, SLOPE, n)
    vortex = Vortex(350.0, core_radius, 0.0, 0.0, model)
    loads = wake_loads(strips, wind(strips, [vortex]), AIRSPEED, DENSITY)
    return loads.moment[0] / (PRESSURE * AREA * SPAN)


def test_strips_converge_and_the_default_suffices_for_a_core_of_three_metres():
    exact = rolling_coefficient("burnham_hallock", 3.0, 2000)
    errors = [abs(rolling_coefficient("burnham_hallock", 3.0, n) / exact - 1) for n in (5, 10, 20)]
    assert errors[0] > 4 * errors[1] > 16 * errors[2]
    for model in ("lamb_oseen", "burnham_hallock"):
        exact = rolling_coefficient(model, 3.0, 2000)
        assert rolling_coefficient(model, 3.0, 40) == pytest.approx(exact, rel=1e-5)


def test_port_wing_rises_in_an_updraught_there():
    strips = wing_strips(SPAN, AREA, SLOPE)
    up = np.zeros((len(strips.areas), 3))
    up[strips.places[:, 1] > 0, 2] = 1.0
    assert wake_loads(strips, up, AIRSPEED, DENSITY).moment[0] > 0


def test_tail_surfaces_pitch_and_yaw():
    """An updraught at the tail moves the nose down, wind to port at the fin to starboard."""
    tail = wing_strips(11.0, 32.0, SLOPE, place=(-14.0, 0.0, 1.0))
    fin = fin_strips(6.0, 27.0, SLOPE, place=(-13.0, 0.0, 1.0))
    gust = np.tile([0.0, 2.0, 1.0], (len(tail.areas) + len(fin.areas), 1))
    loads = wake_loads(joined(tail, fin), gust, AIRSPEED, DENSITY)
    tail_slope = SLOPE / (1 + SLOPE / (np.pi * 11**2 / 32))
    fin_slope = SLOPE / (1 + SLOPE / (np.pi * 2 * 6**2 / 27))
    lift = PRESSURE * 32 * tail_slope * 1.0 / AIRSPEED
    side = PRESSURE * 27 * fin_slope * 2.0 / AIRSPEED
    np.testing.assert_allclose(loads.force, [0, side, lift], rtol=1e-12)
    # centre of pressure of half an elliptic wing: 4 / (3 pi) of its height
    height = 1 + 6 * 4 / (3 * np.pi)
    expected = [-height * side, 14 * lift, -13 * side]
    np.testing.assert_allclose(loads.moment, expected, rtol=1e-3)


@pytest.mark.parametrize("mode", [1, 2])
def test_downwash_at_the_tail_is_that_of_the_wings_trailing_vortices(mode):
    """Far behind the wing, w = -sum n A_n sin(n t) / sin(t) 2 V: twice that at the wing."""
    m = SLOPE / (np.pi * ASPECT_RATIO)  # a0 c / (4 b) / sin t
    # the wind w/V = sin(n t) / sin(t), 1 or 2 cos t, has A_n = m / (1 + n m) alone
    left = 1 - 2 * mode * m / (1 + mode * m)
    tail = wing_strips(11.0, 32.0, SLOPE)
    behind = in_downwash(tail, SLOPE, ASPECT_RATIO)
    name = {1: "slopes", 2: "roll_slopes"}[mode]
    np.testing.assert_allclose(getattr(behind, name) / getattr(tail, name), left)


@pytest.mark.parametrize("bad", [(0.0, 1.0, 5.0, 9), (9.0, -1.0, 5.0, 9), (9.0, 1.0, np.nan, 9)])
def test_bad_surfaces_are_refused(bad):
    with pytest.raises(InputError, match="expected a number > 0"):
        wing_strips(*bad)


def test_one_strip_is_refused():
    with pytest.raises(InputError, match=r"strips\.n: 1"):
        wing_strips(SPAN, AREA, SLOPE, 1)
