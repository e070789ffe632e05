"""A pair across a flight path against closed forms and Biot-Savart integrals. Physics tier.

Detects: a sign or a factor in the geometry (an angle of 0.01 degrees), a flow with divergence, a
descent off by 0.1 %, a deformed vortex whose flow differs from that of the curved lines by more
than the stated fraction.
"""

import math

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.optimize import brentq

from lidar_mi.atmosphere.vortices.vortex import MODELS, descent_speed, velocity, vortex_pair
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.errors import InputError

RANDOM = np.random.default_rng(4)
PLACES = RANDOM.uniform(-60, 60, (3, 40))
OBLIQUE = PairAlongPath(
    458.0,
    crossing_angle=math.radians(35),
    climb_angle=math.radians(-3),
    x_c=600.0,
    t_c=8.0,
    miss=(4.0, -3.0),
    mean_wind=(2.0, -0.3),
    decay_time=50.0,
)


@pytest.mark.parametrize("model", MODELS)
def test_along_the_path_it_is_the_pair_in_the_plane(model):
    wake = PairAlongPath(458.0, model=model, miss=(3.0, -2.0), mean_wind=(1.0, 0.5))
    u, v, w = wake.wind(*PLACES, 0.0)
    expected = velocity(vortex_pair(458.0, y=3.0, z=-2.0, model=model), *PLACES[1:])
    np.testing.assert_allclose(u, 0, atol=1e-12)
    np.testing.assert_allclose((v - 1.0, w - 0.5), expected, atol=1e-12)


def line_integral(point, start, direction, circulation):
    """Biot-Savart integral over a line of strength Gamma, far from its core."""

    def piece(s):
        r = point - (start + s * direction)
        return np.cross(direction, r) / np.linalg.norm(r) ** 3

    far = 40_000.0
    near = float((point - start) @ direction)
    total, _ = quad_vec(piece, -far, far, points=[near - 50, near, near + 50], epsrel=1e-9)
    return circulation / (4 * math.pi) * total


def test_oblique_vortices_by_biot_savart():
    """Both lines built from angles alone, without the code's axes; places outside of the cores."""
    chi, gamma, when = OBLIQUE.crossing_angle, OBLIQUE.climb_angle, 5.0
    # in a level frame (ahead, left, up), then turned down by the climb
    turn = np.array(
        [[math.cos(gamma), 0, math.sin(gamma)], [0, 1, 0], [-math.sin(gamma), 0, math.cos(gamma)]]
    )
    along = turn @ [math.cos(chi), math.sin(chi), 0]
    left = turn @ [-math.sin(chi), math.cos(chi), 0]
    up = turn @ [0, 0, 1]
    strength = 458.0 * math.exp(-when / 50)
    fallen, _ = quad_vec(lambda t: descent_speed(458.0 * math.exp(-t / 50), 47.1), when, 8.0)
    centre = np.array([600.0, 4.0, -3.0]) + fallen * up - 3.0 * np.array([0, 2.0, -0.3])
    for place in ([590.0, 20.0, 15.0], [640.0, 0.0, -20.0], [610.0, -60.0, 5.0]):
        expected = np.array([0.0, 2.0, -0.3])
        for side in (1, -1):
            start = centre + side * 23.55 * left
            expected += line_integral(np.array(place), start, along, side * strength)
        np.testing.assert_allclose(OBLIQUE.wind(*place, when), expected, atol=1e-4)


def test_no_divergence_and_no_vorticity_outside_of_the_cores():
    h = 1e-3
    gradient = np.empty((3, 3, PLACES.shape[1]))
    places = PLACES + np.array([[600.0], [0.0], [0.0]])
    for axis in range(3):
        step = h * np.eye(3)[axis][:, None]
        ahead, behind = (OBLIQUE.wind(*(places + s * step), 8.0) for s in (1, -1))
        gradient[axis] = (np.array(ahead) - np.array(behind)) / (2 * h)
    steep = np.abs(gradient).max()
    assert np.abs(np.trace(gradient)).max() < 1e-6 * steep


def test_circulation_through_a_plane_across_the_path():
    """Around each of the stated places the integral of the wind is the stated circulation."""
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    for when, x in ((8.0, 600.0), (5.0, 560.0)):
        for vortex in OBLIQUE.vortices(x, when):
            y, z = vortex.y + 18 * np.cos(angle), vortex.z + 18 * np.sin(angle)
            _, v, w = OBLIQUE.wind(x, y, z, when)
            around = 18 * 2 * np.pi * np.mean(w * np.cos(angle) - v * np.sin(angle))
            assert around == pytest.approx(vortex.circulation, rel=1e-4)


def test_slopes_of_the_axis():
    near, far = (OBLIQUE.vortices(x, 8.0) for x in (500.0, 600.0))
    for first, second in zip(near, far, strict=True):
        dy, dz = (second.y - first.y) / 100, (second.z - first.z) / 100
        assert dy == pytest.approx(math.tan(math.radians(35)) / math.cos(math.radians(3)), rel=1e-9)
        assert dz == pytest.approx(math.tan(math.radians(3)), rel=1e-9)
    port, starboard = far
    assert (port.y + starboard.y) / 2 == pytest.approx(4.0)
    assert (port.z + starboard.z) / 2 == pytest.approx(-3.0)
    assert port.y - starboard.y == pytest.approx(47.1 / math.cos(math.radians(35)), rel=1e-3)


def test_the_pair_moves_with_the_air_at_its_vortices():
    """Level path along the wake: each vortex drifts with the wind of its partner."""
    wake = PairAlongPath(458.0, core_radius=4.0, decay_time=30.0, mean_wind=(1.0, 0.2), t_c=6.0)
    for when in (0.0, 5.0):
        port, _ = wake.vortices(0.0, when)
        later, _ = wake.vortices(0.0, when + 1e-4)
        _, v, w = wake.wind(0.0, port.y, port.z, when)
        assert (later.y - port.y) / 1e-4 == pytest.approx(v, abs=1e-4)
        assert (later.z - port.z) / 1e-4 == pytest.approx(w, abs=1e-4)
        point_vortices = descent_speed(458.0 * math.exp(-when / 30), 47.1)
        assert w - 0.2 == pytest.approx(-point_vortices, rel=1e-3)


def curved_lines(place, amplitude, wavelength):
    """Biot-Savart sum over both sinusoidal lines, 9 m and more from their cores."""
    s = np.arange(place[0] - 6000, place[0] + 6000, 0.5)
    k, total = 2 * math.pi / wavelength, np.zeros(3)
    for side in (1, -1):
        plane = np.array([0.0, side, 1.0]) / math.sqrt(2)
        line = s[:, None] * [1.0, 0, 0] + amplitude * np.sin(k * s)[:, None] * plane
        tangent = [1.0, 0, 0] + amplitude * k * np.cos(k * s)[:, None] * plane
        r = place - line - np.array([0.0, side * 23.55, 0.0])
        pieces = np.cross(tangent, r) / np.linalg.norm(r, axis=1)[:, None] ** 3
        total += side * 458.0 / (4 * math.pi) * 0.5 * pieces.sum(0)
    return total


@pytest.mark.parametrize(("amplitude", "largest"), [(2.0, 0.05), (5.0, 0.12), (10.0, 0.22)])
def test_deformation_against_curved_lines(amplitude, largest):
    """Anywhere along the wave: 6 % of the change by the deformation at most.

    In m/s; the largest swirl is 15.5 m/s.
    """
    random, wavelength = np.random.default_rng(1), 8.6 * 47.1
    wake, straight = PairAlongPath(458.0, crow_amplitude=amplitude), PairAlongPath(458.0)
    errors, changes = [], []
    while len(errors) < 40:
        place = random.uniform((-wavelength / 2, -50, -30), (wavelength / 2, 50, 30))
        pair = wake.vortices(place[0], 0.0)
        if min(math.hypot(place[1] - v.y, place[2] - v.z) for v in pair) < 9:
            continue
        expected = curved_lines(place, amplitude, wavelength)
        errors.append(np.abs(wake.wind(*place, 0.0) - expected).max())
        changes.append(np.abs(straight.wind(*place, 0.0) - expected).max())
    assert max(errors) < largest
    assert max(errors) < 0.06 * max(changes)


def test_the_axis_of_a_deformed_vortex_is_at_rest_in_its_own_swirl():
    """Far from its partner; at all phases of the wave, oblique."""
    wake = PairAlongPath(
        458.0, separation=5000.0, crow_amplitude=10.0, crow_wavelength=400.0, crossing_angle=0.3
    )
    for x in np.linspace(-200.0, 200.0, 9):
        port, _ = wake.vortices(x, 0.0)
        assert np.abs(wake.wind(x, port.y, port.z, 0.0)).max() < 0.03


def test_deformed_vortices_are_where_the_lines_cross_the_plane():
    """Oblique lines built here, and cut by the plane with a root finder."""
    wake = PairAlongPath(458.0, crow_amplitude=5.0, crow_wavelength=300.0, crossing_angle=0.4)
    along, left = [math.cos(0.4), math.sin(0.4), 0], [-math.sin(0.4), math.cos(0.4), 0]

    def line(s, side):
        shift = 5 * math.sin(2 * math.pi * s / 300) / math.sqrt(2)
        start = side * (23.55 + shift) * np.array(left) + [0, 0, shift]
        return start + s * np.array(along)

    for x in (75.0, -40.0):
        for side, vortex in zip((1, -1), wake.vortices(x, 0.0), strict=True):
            ahead = brentq(lambda s, side=side, x=x: line(s, side)[0] - x, -300, 300)
            _, y, z = line(ahead, side)
            assert (vortex.y, vortex.z) == pytest.approx((y, z), abs=1e-6)
    along = PairAlongPath(458.0, crow_amplitude=5.0, crow_wavelength=300.0)
    port, starboard = along.vortices(75.0, 0.0)  # a crest: outward and up
    assert port.y - starboard.y == pytest.approx(47.1 + 2 * 5 / math.sqrt(2))
    assert port.z == starboard.z == pytest.approx(5 / math.sqrt(2))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"circulation": -1.0}, "circulation"),
        ({"crossing_angle": 2.0}, "crossing_angle"),
        ({"crow_amplitude": 30.0}, "crow_amplitude"),
        ({"decay_time": 0.0}, "decay_time"),
    ],
)
def test_bad_values(change, named):
    with pytest.raises(InputError, match=named):
        PairAlongPath(**({"circulation": 458.0} | change))


def test_a_wake_across_the_path_has_wind_but_no_vortices_in_the_plane():
    wake = PairAlongPath(458.0, crossing_angle=math.pi / 2)
    u, v, w = wake.wind(23.55, 5.0, 3.0, 0.0)
    assert v == pytest.approx(0, abs=1e-9) and abs(u) > 1 and abs(w) > 1
    with pytest.raises(InputError, match="crossing_angle"):
        wake.vortices(0.0, 0.0)
