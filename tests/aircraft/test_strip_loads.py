"""Unsteady lift, stall and wind along the body, on strips.

Detects indicial functions that are not those of Wagner and Kuessner, states that are inexact, loads
that differ from quasi-steady ones where nothing is asked for or after a long time, motion of
another sign than that of the aircraft's damping, and lift that grows beyond the stall.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import hankel2, ive, jv, kve

from lidar_mi.aircraft.heave_model import HeaveModel
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import loads_in_wind
from lidar_mi.aircraft.strip_loads import KUESSNER, WAGNER, Memory, StripLoads
from lidar_mi.schema.aerodynamics import Aerodynamics
from lidar_mi.schema.encounter import Aircraft, Path

FREQUENCIES = np.array([0.001, 0.01, 0.03, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0])
MASS = 48500.0


def theodorsen(k):
    one, zero = hankel2(1, k), hankel2(0, k)
    return one / (one + 1j * zero)


def uniform(u=0.0, w=0.0):
    return lambda x, y, z, t: (u + 0 * x, 0 * x, w + 0 * x)


def model(kind=HeaveModel, **keys):
    return kind(Aircraft(**keys), Path())


def test_wagner_is_the_closed_form():
    """Within .01: the approximation's own error. The integral is that of Sears 1940."""

    def exact(s):
        def density(x):
            bessel = (kve(0, x) - kve(1, x)) ** 2 * np.exp(-2 * x)
            bessel += np.pi**2 * (ive(0, x) + ive(1, x)) ** 2 * np.exp(2 * x)
            return np.exp(-x * s) / x**2 / bessel

        return 1 - quad(density, 0, 30, limit=200, points=[0.01, 0.1, 1.0])[0]

    for s in (0.0, 0.5, 2.0, 5.0, 10.0, 20.0, 50.0):
        found = 1 - np.sum(np.array(WAGNER.weights) * np.exp(-np.array(WAGNER.rates) * s))
        assert found == pytest.approx(exact(s), abs=0.01), s


def test_responses_are_those_of_theodorsen_and_sears():
    """Motion within .02 of the steady lift, gusts within .025, fast ones within .06.

    Sears' function is of the gust in the middle of the chord, half a chord behind the leading edge.
    """
    exact = theodorsen(FREQUENCIES)
    assert abs(WAGNER.response(FREQUENCIES) - exact).max() < 0.02
    j0, j1 = jv(0, FREQUENCIES), jv(1, FREQUENCIES)
    sears = (j0 - 1j * j1) * exact + 1j * j1
    at_edge = sears * np.exp(-1j * FREQUENCIES)
    errors = abs(KUESSNER.response(FREQUENCIES) - at_edge)
    assert errors.max() < 0.06 and errors[FREQUENCIES <= 0.5].max() < 0.025
    assert KUESSNER.response(np.array([0.0])) == pytest.approx(1.0)


@pytest.mark.parametrize("indicial", [WAGNER, KUESSNER])
def test_a_memory_has_the_response(indicial):
    """Of ramps exactly, whatever the steps; of waves to the linear interpolation."""
    rate, dt, k = np.array([20.0, 60.0]), 0.002, 0.3
    memory = Memory(indicial, rate)
    memory(0.0, np.zeros(2))
    random, t = np.random.default_rng(1), 0.0
    for _ in range(50):
        step = random.uniform(0.001, 0.02)
        t += step
        found = memory(step, t * np.ones(2))
    a, b = (np.array(one)[:, None] for one in (indicial.weights, indicial.rates))
    expected = t - (a * -np.expm1(-b * rate * t) / (b * rate)).sum(axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    memory, times = Memory(indicial, rate), dt * np.arange(10000)
    waves = np.array([memory(dt, np.cos(k * rate * t)) for t in times])
    expected = (indicial.response(k) * np.exp(1j * k * np.outer(times, rate))).real
    np.testing.assert_allclose(waves[-500:], expected[-500:], atol=2e-3)


def test_by_default_loads_are_quasi_steady():
    aircraft, random = model(), np.random.default_rng(2)

    def wind(x, y, z, t):
        return 3 + 0 * x, np.sin(y), np.cos(0.3 * y) + 0.1 * x

    met = StripLoads(aircraft, wind, Aerodynamics(), MASS)
    for time in (0.0, 0.01, 0.5):
        state = replace(
            aircraft.state,
            time=time,
            x=75 * time,
            **dict(zip(("roll", "pitch", "roll_rate", "z"), random.normal(0, 0.1, 4), strict=True)),
        )
        found = met(state)
        expected = loads_in_wind(aircraft.strips, state, wind, aircraft.density)
        np.testing.assert_allclose(found.moment, expected.moment, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(found.force, expected.force, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(found.bending, expected.bending, rtol=1e-9, atol=1e-6)


def test_lift_of_a_gust_grows_as_kuessner():
    """Of a wing that flies into rising air: the sum of its strips, each with its own chord."""
    aircraft = model(RollModel)
    edge = 10.0

    def wind(x, y, z, t):
        return 0 * x, 0 * x, 2.0 * (x > edge)

    met = StripLoads(aircraft, wind, Aerodynamics(lift="unsteady"), MASS)
    speed, dt, lift = aircraft.state.airspeed, 0.001, []
    times = dt * np.arange(1500)
    for t in times:
        lift.append(met(replace(aircraft.state, time=t, x=speed * t)).force[2])
    strips = aircraft.strips
    distance = speed * times[:, None] + strips.chords / 4 - edge
    s = np.maximum(0, 2 * distance / strips.chords)
    a, b = (np.array(one)[:, None, None] for one in (KUESSNER.weights, KUESSNER.rates))
    grown = 1 - (a * np.exp(-b * s)).sum(axis=0)
    weight = 0.5 * aircraft.density * speed * strips.areas * strips.slopes * 2.0
    expected = np.where(distance > 0, grown, 0.0) @ weight
    # a step of flight is half of a half chord of the outer strips
    np.testing.assert_allclose(lift, expected, atol=0.03 * expected[-1])
    assert lift[-1] == pytest.approx(weight.sum(), rel=0.02)


def test_half_of_the_roll_damping_acts_at_once():
    """Wagner's function starts at 1/2: the other half is in the loads and disappears slowly."""
    aircraft = model()
    met = StripLoads(aircraft, uniform(), Aerodynamics(lift="unsteady"), MASS)
    met(aircraft.state)
    rolling = replace(aircraft.state, roll_rate=0.1, time=1e-9)
    expected = -0.5 * aircraft.roll_damping * 0.1
    assert met(rolling).moment[0] == pytest.approx(expected, rel=1e-3)
    later = [abs(met(replace(rolling, time=t)).moment[0]) for t in (0.1, 1.0, 20.0)]
    assert later[0] > later[1] > later[2] and later[2] < 1e-3 * expected
    # rising air and a falling aircraft are the same to a wing, at the end
    met = StripLoads(aircraft, uniform(), Aerodynamics(lift="unsteady"), MASS)
    met(aircraft.state)
    sinking = replace(aircraft.state, vertical_speed=-1.0, time=1e-9)
    quasi_steady = loads_in_wind(aircraft.strips, aircraft.state, uniform(w=1.0), aircraft.density)
    assert met(sinking).force[2] == pytest.approx(-0.5 * quasi_steady.force[2], rel=1e-3)


def test_lift_does_not_grow_beyond_the_stall():
    """The lift that a wing has in addition: from that of its weight to the largest."""
    aircraft = model(RollModel)
    met = StripLoads(aircraft, uniform(w=30.0), Aerodynamics(largest_lift_coefficient=1.8), MASS)
    pressure = 0.5 * aircraft.density * aircraft.state.airspeed**2 * 108.8
    expected = 1.8 * pressure - MASS * 9.80665
    assert met(aircraft.state).force[2] == pytest.approx(expected, rel=1e-6)
    met = StripLoads(aircraft, uniform(w=1.0), Aerodynamics(largest_lift_coefficient=1.8), MASS)
    small = loads_in_wind(aircraft.strips, aircraft.state, uniform(w=1.0), aircraft.density)
    assert met(aircraft.state).force[2] == pytest.approx(small.force[2])
    # a stalled wing does not damp roll: the loads take the damping of the model away
    met = StripLoads(aircraft, uniform(w=60.0), Aerodynamics(largest_lift_coefficient=1.8), MASS)
    rolling = replace(aircraft.state, roll_rate=0.05)
    assert met(rolling).moment[0] == pytest.approx(-aircraft.roll_damping * 0.05, rel=1e-6)


def test_wind_along_changes_the_weight_that_is_carried():
    """Lift grows as the square of the airspeed: head wind of 5 m/s at 75 m/s adds 13.8 %."""
    aircraft = model()
    met = StripLoads(aircraft, uniform(u=-5.0), Aerodynamics(wind_along=True), MASS)
    speed = aircraft.state.airspeed
    expected = MASS * 9.80665 * ((1 + 5 / speed) ** 2 - 1)
    assert met(aircraft.state).force[2] == pytest.approx(expected)
    # more of it at the port wing rolls as the difference of lift does
    met = StripLoads(
        aircraft, lambda x, y, z, t: (-0.1 * y, 0 * x, 0 * x), Aerodynamics(wind_along=True), MASS
    )
    assert met(aircraft.state).moment[0] > 0
