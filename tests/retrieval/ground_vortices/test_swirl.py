"""Vortices through the range weighting, and turbulence through it. Unit and physics tiers.

Detects: a swirl or its weighting that differs from quadrature; a derivative of the wrong sign or
size; a vortex that moves otherwise than by induction; a covariance of gates that differs from
quadrature.
"""

import numpy as np
import pytest
import scipy

from lidar_mi.atmosphere.vortices.vortex import tangential_speed
from lidar_mi.instrument.coherent.weighting import range_weight
from lidar_mi.retrieval.ground_vortices.fit import Air, Assumptions, Problem, State, crossing_time
from lidar_mi.retrieval.ground_vortices.scan_plane import plane_scans
from lidar_mi.retrieval.ground_vortices.swirl import circulation_5_15, motion, shape
from lidar_mi.retrieval.ground_vortices.turbulence import of_gates
from lidar_mi.retrieval.ground_vortices.window import window_of
from tests.support.line_wakes import LIDAR, START, Family, drawn

CALM = Family(sigma=0.0)


@pytest.mark.parametrize("model", ["lamb_oseen", "burnham_hallock"])
def test_shape_is_that_of_the_swirl(model):
    radius = np.concatenate([[1e-4], np.geomspace(0.05, 40, 30)])
    value, slope = shape((radius / 2.5) ** 2, model)
    speed = 300 / (2 * np.pi * 2.5**2) * value * radius
    np.testing.assert_allclose(speed, tangential_speed(radius, 300.0, 2.5, model), rtol=1e-6)
    square = np.array([0.0, 1e-5, 0.1, 1.0, 30.0])
    ahead, behind = shape(square + 1e-5, model)[0], shape(square - 1e-5, model)[0]
    np.testing.assert_allclose(
        shape(square, model)[1], (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-6
    )
    del slope


def test_circulation_from_5_to_15_m_of_burnham_hallock():
    """Mean of r^2 / (r^2 + c^2): 1 - c / 10 (atan 15 / c - atan 5 / c)."""
    core = np.array([1.0, 3.0, 6.0])
    expected = 1 - core / 10 * (np.arctan(15 / core) - np.arctan(5 / core))
    found = circulation_5_15(core, np.zeros(3), "burnham_hallock")
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    other = circulation_5_15(core, np.ones(3), "lamb_oseen")
    np.testing.assert_allclose(other, expected, rtol=1e-5)


def test_a_pair_descends_and_spreads_over_the_ground():
    """Gamma / (2 pi b) down; of one vortex near the ground Gamma / (4 pi h) along it."""
    pair = np.array([[0.0, 500.0, -400.0, 0.0], [40.0, 500.0, 400.0, 0.0]])
    speed = motion(pair, np.array([2.0]), 0.0, None, "lamb_oseen")
    np.testing.assert_allclose(speed, [[2, -400 / (2 * np.pi * 40)]] * 2, rtol=1e-9)
    one = np.array([[0.0, 20.0, 400.0, 0.0]])
    speed = motion(one, np.array([0.0]), 0.0, 0.0, "lamb_oseen")
    # a vortex that turns from y to z, over the ground, moves to larger y
    np.testing.assert_allclose(speed, [[400 / (4 * np.pi * 20), 0]], atol=1e-9)


def problem_of(one, ground=None, model="lamb_oseen"):
    (scan,), _ = plane_scans(one.lines, None)
    middle = one.at(START + np.timedelta64(3, "s")).mean(0)
    distance, angle = np.hypot(*middle), np.arctan2(middle[1], middle[0])
    aside = 60 / distance
    window = window_of(
        scan, LIDAR, (distance - 75, distance + 75), (angle - aside, angle + aside), cell=0.1
    )
    start = one.at(START + np.timedelta64(3, "s"))
    vortices = np.column_stack([start, one.circulations, np.log(one.core_radii)])
    time = crossing_time(window, vortices)
    vortices[:, :2] = one.at(scan.at(time))
    given = Assumptions(model=model, ground=ground)
    return Problem(window, given, time, float(middle[1])), vortices


@pytest.mark.parametrize("profile", ["lamb_oseen", "burnham_hallock"])
@pytest.mark.parametrize("ground", [None, -2.0])
def test_velocities_are_those_of_quadrature(profile, ground):
    """Within 1 cm/s of simulated lines of a pair that moves: beams that move, weighted gates.

    What differs is the curve of the path, of which a window has some seconds: 3 mm/s. The wind is
    fitted, as the simulation's is not known to this test.
    """
    family = Family(sigma=0.0, profile=profile, ground=ground, snr=1e3, heights=(60.0, 90.0))
    one = drawn(family, 3)
    one.lines["radial_velocity"] = one.lines["radial_velocity_true"]
    problem, vortices = problem_of(one, ground, profile)
    state = State(vortices, np.zeros((2, 2)), np.zeros(1), np.zeros(3))
    for _ in range(3):
        value, slope = problem.predicted(state)
        residual = problem.window.velocity - value
        wind, *_ = np.linalg.lstsq(slope[:, -3:], residual, rcond=None)
        state = State(vortices, np.zeros((2, 2)), np.zeros(1), state.wind + wind)
    residual = problem.window.velocity - problem.predicted(state)[0]
    assert np.abs(residual).max() < 0.01
    assert residual.std() < 2e-3


def test_derivatives_are_those_of_differences():
    problem, vortices = problem_of(drawn(CALM, 1), ground=-2.0)
    state = State(vortices, np.full((2, 2), 0.2), np.array([0.1]), np.array([1.0, 0.02, 1e-4]))
    _, slope = problem.predicted(state)
    vector = state.vector
    for k in range(len(vector)):
        step = 1e-4 * max(1.0, abs(vector[k]))
        ends = [vector + side * step * np.eye(len(vector))[k] for side in (1, -1)]
        values = [problem.predicted(state.of(end))[0] for end in ends]
        expected = (values[0] - values[1]) / (2 * step)
        np.testing.assert_allclose(
            slope[:, k], expected, atol=2e-5 * max(np.abs(expected).max(), 1e-6), rtol=1e-4
        )


def test_covariance_of_gates_is_that_of_quadrature():
    """Of von Karman's turbulence through both weights; a narrow cell."""
    offset = np.arange(-75, 75.1, 1.0)
    weight = range_weight(offset, LIDAR)
    weight /= weight.sum()

    def expected(along, across, length):
        apart = along + offset[:, None] - offset
        distance = np.sqrt(apart**2 + across**2 + 1e-12)
        q = distance / (1.339 * length)
        f = 2 ** (2 / 3) / scipy.special.gamma(1 / 3) * np.cbrt(q) * scipy.special.kv(1 / 3, q)
        less = 2 ** (-1 / 3) / scipy.special.gamma(1 / 3) * np.cbrt(q) ** 4
        g = f - less * scipy.special.kv(2 / 3, q)
        full = g + (f - g) * apart**2 / distance**2
        return weight @ full @ weight

    along, across = np.array([0.0, 0.0, 15.0, 40.0, 90.0]), np.array([3.0, 40.0, 0.7, 10.0, 60.0])
    found = of_gates(along, across, LIDAR, (40.0, 150.0), 0.5)
    for row, length in zip(found, (40.0, 150.0), strict=True):
        exact = [expected(x, s, length) for x, s in zip(along, across, strict=True)]
        np.testing.assert_allclose(row, exact, atol=3e-3)


def test_air_of_a_length_is_symmetric_and_positive():
    problem, _ = problem_of(drawn(CALM, 2))
    full = problem.turbulence
    np.testing.assert_allclose(full, full.transpose(0, 2, 1), atol=1e-12)
    assert problem.factor(Air(2.0, 225.0)).shape == full.shape[1:]
