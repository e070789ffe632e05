"""Strip theory against closed forms and against Prandtl's lifting line.

Detects 1e-9 relative in lift, damping and rolling moment, any sign error, and a wrong correction
for the finite span.
"""

import numpy as np
import pytest
from scipy.special import ive

from lidar_mi.aircraft.strips import (
    fin_strips,
    finite_span_slope,
    in_downwash,
    joined,
    roll_damping,
    wake_loads,
    wing_strips,
)
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


def core_factor(model, core_radius):
    """Rolling moment on the axis over that of a point vortex, a Gamma / (2 pi V b).

    From the integrals of 2/pi sqrt(1 - x^2) over (-1, 1) with x^2 / (x^2 + e^2) (a residue at
    i e) and with 1 - exp(-k x^2) (x = sin t gives modified Bessel functions), e = 2 r_c / b.
    """
    e = 2 * core_radius / SPAN
    if model == "burnham_hallock":
        return 1 + 2 * e**2 - 2 * e * np.sqrt(1 + e**2)
    k = 1.2564 / e**2
    return 1 - ive(0, k / 2) - ive(1, k / 2)


@pytest.mark.parametrize("model", ["lamb_oseen", "burnham_hallock"])
@pytest.mark.parametrize("core_radius", [1.0, 3.0, 10.0])
def test_rolling_moment_on_the_axis_of_a_vortex(model, core_radius):
    slope = SLOPE / (1 + 2 * SLOPE / (np.pi * ASPECT_RATIO))
    expected = slope * 350 / (2 * np.pi * AIRSPEED * SPAN) * core_factor(model, core_radius)
    assert rolling_coefficient(model, core_radius, 200) == pytest.approx(expected, rel=1e-5)


def test_rolling_moment_of_a_point_vortex_on_the_axis():
    """a Gamma / (2 pi V b), whatever the wing's area: a core of 1e-6 m is a point."""
    slope = finite_span_slope(SLOPE, ASPECT_RATIO, 2)
    expected = slope * 350 / (2 * np.pi * AIRSPEED * SPAN)
    assert rolling_coefficient("burnham_hallock", 1e-6, 40) == pytest.approx(expected, rel=1e-9)


def test_strips_converge_and_the_default_suffices_for_a_core_of_three_metres():
    exact = rolling_coefficient("burnham_hallock", 3.0, 2000)
    errors = [abs(rolling_coefficient("burnham_hallock", 3.0, n) / exact - 1) for n in (5, 10, 20)]
    assert errors[0] > 4 * errors[1] > 16 * errors[2]
    for model in ("lamb_oseen", "burnham_hallock"):
        exact = rolling_coefficient(model, 3.0, 2000)
        assert rolling_coefficient(model, 3.0, 40) == pytest.approx(exact, rel=1e-5)


def test_uniform_gust_lifts():
    strips = wing_strips(SPAN, AREA, SLOPE)
    gust = np.tile([3.0, -2.0, 1.5], (len(strips.areas), 1))
    loads = wake_loads(strips, gust, AIRSPEED, DENSITY)
    slope = SLOPE / (1 + SLOPE / (np.pi * ASPECT_RATIO))
    lift = PRESSURE * AREA * slope * 1.5 / AIRSPEED
    np.testing.assert_allclose(loads.force, [0, 0, lift], rtol=1e-12)
    np.testing.assert_allclose(loads.moment, 0, atol=1e-9 * lift * SPAN)


def test_roll_damping_of_an_elliptic_wing():
    """C_lp = -a/8 with respect to p b / 2 V, from the integral of c y^2 = S b^2 / 16."""
    slope = SLOPE / (1 + 2 * SLOPE / (np.pi * ASPECT_RATIO))
    damping = roll_damping(wing_strips(SPAN, AREA, SLOPE, 2), AIRSPEED, DENSITY)
    c_lp = damping / (PRESSURE * AREA * SPAN) * 2 * AIRSPEED / SPAN
    assert c_lp == pytest.approx(-slope / 8, rel=1e-12)


def lifting_line(angle_of, modes=120):
    """Lift and rolling moment coefficients of the elliptic wing, by collocation.

    Gamma = 2 b V sum A_n sin(n t), y = b/2 cos t; sum A_n sin(n t) (n m / sin t + 1) =
    m angle, m = a0 c / (4 b) (Glauert 1926). C_L = pi A A_1; C_l = pi A A_2 / 4.
    """
    t = (np.arange(modes) + 0.5) * np.pi / modes
    y = SPAN / 2 * np.cos(t)
    chord = 4 * AREA / (np.pi * SPAN) * np.sin(t)
    m = SLOPE * chord / (4 * SPAN)
    n = np.arange(1, modes + 1)
    matrix = np.sin(np.outer(t, n)) * (n * (m / np.sin(t))[:, None] + 1)
    a = np.linalg.solve(matrix, m * angle_of(y))
    return np.pi * ASPECT_RATIO * a[0], np.pi * ASPECT_RATIO * a[1] / 4


@pytest.mark.parametrize("place", [(0.0, 0.0), (9.0, 2.0), (-14.0, 0.5), (30.0, -4.0)])
def test_lift_and_rolling_moment_are_those_of_the_lifting_line(place):
    vortices = [Vortex(350.0, 3.0, *place)]
    strips = wing_strips(SPAN, AREA, SLOPE, 120)
    loads = wake_loads(strips, wind(strips, vortices), AIRSPEED, DENSITY)
    lift, rolling = lifting_line(lambda y: velocity(vortices, y, np.zeros_like(y))[1] / AIRSPEED)
    scale = PRESSURE * AREA
    assert loads.force[2] / scale == pytest.approx(lift, rel=1e-3, abs=1e-6)
    assert loads.moment[0] / scale / SPAN == pytest.approx(rolling, rel=1e-3, abs=1e-6)


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
