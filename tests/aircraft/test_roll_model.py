"""The rolling aircraft against the closed solution of its equation.

Detects 1e-9 relative in roll angle and rate, for constant moments and a moving aileron, and steps
that depend on their length.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import Commands
from lidar_mi.aircraft.strips import Loads
from lidar_mi.schema.encounter import Aircraft, Path


def model(**aircraft):
    return RollModel(Aircraft(**aircraft), Path())


def loads(moment):
    return Loads(np.zeros(3), np.array([moment, 0.0, 0.0]))


def test_step_response():
    """p = p_end (1 - exp(-t / tau)), roll = p_end (t - tau (1 - exp(-t / tau)))."""
    rolling = model()
    for _ in range(120):
        state = rolling.step(1 / 120, loads(2e5), Commands())
    tau = 8.0e5 / -rolling.roll_damping
    end, grown = 2e5 / -rolling.roll_damping, -np.expm1(-1 / tau)
    assert rolling.time_constant == pytest.approx(tau, rel=1e-12)
    assert state.roll_rate == pytest.approx(end * grown, rel=1e-9)
    assert state.roll == pytest.approx(end * (1 - tau * grown), rel=1e-9)
    assert state.time == pytest.approx(1) and state.x == pytest.approx(75)


def test_time_constant_of_a_transport_aircraft():
    """0.3 to 1.4 s: the roll mode of level 1 (MIL-HDBK-1797, class III)."""
    assert 0.3 < model().time_constant < 1.4


@pytest.mark.parametrize("step", [0.7, 0.1, 1 / 120])
def test_moving_aileron_against_an_integrator(step):
    """The aileron moves at its rate, then rests; 0.7 s holds both."""
    rolling = model()
    count = round(0.7 / step)
    for _ in range(count):
        state = rolling.step(0.7 / count, loads(-1e5), Commands(aileron=np.radians(15)))
    power, damping = rolling.control_moments[0, 0], rolling.roll_damping

    def derivative(t, y):
        deflection = min(np.radians(50) * t, np.radians(15))
        return [y[1], (-1e5 + power * deflection + damping * y[1]) / 8.0e5]

    exact = solve_ivp(derivative, (0, 0.7), [0, 0], rtol=1e-10, atol=1e-12, max_step=0.01).y[:, -1]
    np.testing.assert_allclose([state.roll, state.roll_rate], exact, rtol=1e-6)
    assert rolling.deflection[0] == pytest.approx(np.radians(15))


def test_aileron_moment():
    """Steady roll rate (2 V / b) C_lda da / -C_lp, C_lp = -a/8 of the elliptic wing."""
    rolling = model(aileron_rate="100 rad/s")
    for _ in range(50):
        state = rolling.step(0.5, loads(0.0), Commands(aileron=0.01))
    slope = 5.3 / (1 + 2 * 5.3 * 108.8 / (np.pi * 28.9**2))
    assert state.roll_rate == pytest.approx(2 * 75 / 28.9 * 0.1 * 0.01 * 8 / slope, rel=1e-9)


def test_departure_is_a_state():
    rolling = model()
    for _ in range(200):
        state = rolling.step(0.05, loads(1e7), Commands())
    assert state.departed and np.isfinite(state.roll) and state.time == pytest.approx(10)


def test_a_moment_that_is_no_number_loses_the_flight():
    rolling = model()
    assert rolling.step(0.05, loads(np.nan), Commands()).departed
