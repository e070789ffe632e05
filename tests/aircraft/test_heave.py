"""The aircraft that rises and pitches, against closed forms.

Detects 1 % in a derivative or a bending moment, a wrong sign of pitch, elevator or symmetric
aileron, roll that differs from that of the roll model. `validation.loads` has gusts, the pull-up
and the short period; tests/validation runs it.
"""

import numpy as np
import pytest
from scipy.constants import g

from lidar_mi.aircraft.heave import aileron_lift, derivatives_of, wing_place
from lidar_mi.aircraft.heave_model import HeaveModel
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import (
    AircraftState,
    Commands,
    Limits,
    RisingAircraft,
    ailerons_deflected,
    loads_in_wind,
)
from lidar_mi.aircraft.strips import Loads
from lidar_mi.schema.encounter import Aircraft, Path

SPEED, AREA, SPAN, MASS = 75.0, 108.8, 28.9, 48500.0
CHORD, RATIO = AREA / SPAN, SPAN**2 / AREA
SLOPE = 5.3 / (1 + 5.3 / (np.pi * RATIO))
TAIL_SLOPE, TAIL_AREA, ARM = 5.3 / (1 + 5.3 / (np.pi * 4)), 32.3, 14.64
DOWNWASH = 2 * SLOPE / (np.pi * RATIO)
NOTHING = Loads(np.zeros(3), np.zeros(3))


def model(**heave):
    return HeaveModel(Aircraft(model="heave", heave=heave), Path(climb_angle=0.0))


def flown(aircraft, duration, wind=None, commands=Commands(), step=0.01):  # noqa: B008
    """States of a flight through a wind(x, t)."""
    states = []
    for _ in range(round(duration / step)):
        loads = NOTHING
        if wind:

            def air(x, y, z, t):
                return 0 * x * y, 0 * x * y, wind(x + 0 * y, t)

            loads = loads_in_wind(aircraft.strips, aircraft.state, air, aircraft.density)
        states.append(aircraft.step(step, loads, commands))
    return states


def of(states, name):
    return np.array([getattr(one, name) for one in states])


def pressure(aircraft):
    return 0.5 * aircraft.density * SPEED**2


def test_it_is_an_aircraft_whose_loads_are_planned():
    assert isinstance(model(), RisingAircraft)
    assert not isinstance(RollModel(Aircraft(), Path()), RisingAircraft)


# --- derivatives and modes --------------------------------------------------------------------


def test_static_margin_and_pitch_damping():
    """C_m_alpha = -margin C_L_alpha; C_m_q and C_m_alpha' of the tail are -2 a_t V_H l_t / c."""
    one = model()
    force, moment = derivatives_of(Aircraft(), SPEED, one.density)
    lift = pressure(one) * AREA
    assert moment[0] / force[0] == pytest.approx(-0.23 * CHORD, rel=1e-9)
    lift_slope = SLOPE + TAIL_SLOPE * (1 - DOWNWASH) * TAIL_AREA / AREA
    assert force[0] / lift == pytest.approx(lift_slope, rel=1e-9)
    # textbooks have the wing at the centre of gravity: here it is 1.3 m before
    place = wing_place(Aircraft())
    volume = TAIL_AREA * ARM / (AREA * CHORD)
    by_tail = -2 * TAIL_SLOPE * volume * ARM / CHORD
    unit = lift * CHORD * CHORD / (2 * SPEED)
    by_wing = -2 * SLOPE * (place / CHORD) ** 2
    both = by_tail * (1 + DOWNWASH * place / ARM) + by_wing
    assert moment[2] / unit == pytest.approx(both, rel=1e-9)
    assert moment[1] / unit == pytest.approx(by_tail * DOWNWASH * (1 + place / ARM), rel=1e-9)
    # JSBSim's 737 has -27 and -16
    assert -40 < moment[2] / unit < -25 and -17 < moment[1] / unit < -11


def test_a_force_moves_the_mass_and_a_moment_turns_it():
    """At once: h'' = F / m but for the downwash of the rate of alpha (1 %), q' = M / I."""
    state = model().step(1e-3, Loads(np.array([0, 0, 1e4]), np.zeros(3)), Commands())
    assert state.load_factor - 1 == pytest.approx(1e4 / MASS / g, rel=0.02)
    assert state.vertical_speed == pytest.approx(1e-3 * 1e4 / MASS, rel=0.02)
    state = model().step(1e-3, Loads(np.zeros(3), np.array([0, 1e5, 0])), Commands())
    assert state.pitch_rate == pytest.approx(-1e-3 * 1e5 / 2.1e6, rel=1e-3)


def test_steps_do_not_matter():
    """Loads that are constant and controls at rest: exact."""
    loads = Loads(np.array([0, 0, 1e5]), np.array([1e4, 2e4, 0]))
    one, other = model(), model()
    for _ in range(100):
        fine = one.step(0.01, loads, Commands())
    coarse = other.step(1.0, loads, Commands())
    for name in ("z", "vertical_speed", "pitch", "pitch_rate", "roll", "load_factor"):
        assert getattr(coarse, name) == pytest.approx(getattr(fine, name), rel=1e-9)


def test_roll_is_that_of_the_roll_model():
    """Without a tail to speak of."""
    both = model(tail_area=0.011), RollModel(Aircraft(), Path(climb_angle=0.0))
    loads = Loads(np.zeros(3), np.array([2e5, 0.0, 0.0]))
    for _ in range(150):
        heave, roll = (one.step(0.01, loads, Commands(aileron=-0.1)) for one in both)
    assert heave.roll == pytest.approx(roll.roll, rel=2e-4) and heave.pitch == 0


# --- gusts ------------------------------------------------------------------------------------


# --- bending, and symmetric ailerons ----------------------------------------------------------


def test_bending_of_uniform_wind():
    """Half the wing's lift at 4 / (3 pi) of half the span, and none by the tail."""
    one = model()
    wind = lambda x, y, z, t: (0 * y, 0 * y, 0 * y + 1.0)  # noqa: E731
    loads = loads_in_wind(one.strips, AircraftState(airspeed=SPEED), wind, one.density)
    lift = 0.5 * one.density * SPEED * AREA * SLOPE
    arm = 4 / (3 * np.pi) * SPAN / 2
    np.testing.assert_allclose(loads.bending, lift / 2 * arm, rtol=2e-3)


def test_bending_in_a_roll():
    """A linear wind bends one wing up and one down: their difference is the rolling moment."""
    one = model(tail_area=0.011)
    wind = lambda x, y, z, t: (0 * y, 0 * y, 0.1 * y)  # noqa: E731
    loads = loads_in_wind(one.strips, AircraftState(airspeed=SPEED), wind, one.density)
    port, starboard = loads.bending
    assert port == pytest.approx(-starboard) and port > 0
    assert port - starboard == pytest.approx(loads.moment[0], rel=1e-4)


def test_bending_in_a_pull_up():
    """By the lift that the wing has of the pull-up, less its own weight times the load factor."""
    one = model()
    last = flown(one, 20.0, commands=Commands(elevator=-0.02))[-1]
    alpha = (
        last.pitch
        - last.vertical_speed / SPEED
        - last.pitch_rate * wing_place(Aircraft()) / (SPEED)
    )
    arm, load = 4 / (3 * np.pi) * SPAN / 2, last.load_factor - 1
    lift = pressure(one) * AREA * SLOPE * alpha
    expected = (lift - 0.17 * MASS * g * load) / 2 * arm
    assert last.port_bending == pytest.approx(expected, rel=1e-6)
    assert last.starboard_bending == pytest.approx(expected, rel=1e-6)


def lifting_line(symmetric):
    """Lift coefficient, rolling moment and bending of ailerons, per angle of the sections.

    Prandtl's equation of an elliptic wing: the mode n of the angle of attack times sin(theta) has
    the slope a0 / (1 + n a0 / (pi A)).
    """
    theta = (np.arange(20000) + 0.5) * np.pi / 20000
    eta = np.cos(theta)
    angle = ((np.abs(eta) > 0.7) & (np.abs(eta) < 0.95)) * (1.0 if symmetric else np.sign(eta))
    lift = np.zeros_like(theta)
    for n in range(1, 400):
        part = 2 / np.pi * (angle * np.sin(theta) * np.sin(n * theta)).mean() * np.pi
        lift += 5.3 / (1 + n * 5.3 / (np.pi * RATIO)) * part * np.sin(n * theta)
    # chord times section lift over S / b: elliptic chord
    along = 4 / np.pi * lift * np.sin(theta) / 2 * (np.pi / 20000)
    return along.sum(), (along * eta).sum() / 2, (along * np.abs(eta)).sum() / 2


def test_symmetric_ailerons_against_the_lifting_line():
    """Lift is exact; bending of strips is larger: their modes above the second are too large."""
    ailerons = aileron_lift(Aircraft())
    effect = 0.1 / lifting_line(False)[1]
    lift, _, bending = lifting_line(True)
    assert ailerons.lift == pytest.approx(effect * lift, rel=5e-3)
    assert effect * bending < ailerons.bending < 1.15 * effect * bending


def test_symmetric_ailerons_lift():
    one = model()
    state = one.step(0.01, NOTHING, Commands(symmetric_aileron=0.005))
    force = pressure(one) * AREA * aileron_lift(Aircraft()).lift * 0.005
    assert state.load_factor - 1 == pytest.approx(force / MASS / g, rel=0.02)
    assert state.port_bending > 0 and state.port_bending == pytest.approx(state.starboard_bending)
    assert state.roll == 0


def test_both_ailerons_keep_their_limits():
    """Random commands: no aileron beyond its stop or faster than its rate; roll comes first."""
    limits = Limits(np.array([0.35, 0.3, 0.0]), np.array([0.8, 0.8, 0.0]), 0.2)
    random, now = np.random.default_rng(3), np.zeros(2)
    for _ in range(300):
        roll, lift = random.uniform(-0.6, 0.6, 2)
        commands = Commands(roll, symmetric_aileron=lift)
        after = np.array(ailerons_deflected(*now, commands, 0.1, limits))
        for sign in (1, -1):
            port, before = after[1] + sign * after[0], now[1] + sign * now[0]
            assert abs(port) <= 0.35 + 1e-12 and abs(port - before) <= 0.08 + 1e-12
        now = after
    for _ in range(20):
        now = ailerons_deflected(*now, Commands(0.3, symmetric_aileron=-0.2), 0.1, limits)
    np.testing.assert_allclose(now, [0.3, -0.05])


def test_departure_is_a_state():
    one = model()
    loads = Loads(np.array([0, 0, np.nan]), np.zeros(3))
    assert one.step(0.01, loads, Commands()).departed
    assert one.step(0.01, NOTHING, Commands()).time == pytest.approx(0.02)
