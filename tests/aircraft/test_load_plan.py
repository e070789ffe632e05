"""Elevator and symmetric ailerons against a gust, with a perfect preview.

Detects a wrong sign of a control in the plan, a plan far from the best possible, controls beyond
their limits, ailerons that roll and lift beyond their travel, an autopilot that leaves its path, an
aircraft of JSBSim whose equations are not those of its flight.
"""

import numpy as np
import pytest
from scipy.constants import g
from scipy.optimize import linprog
from scipy.signal import lsim

from lidar_mi.aircraft.control import feedforward, no_loads, wings_level
from lidar_mi.aircraft.heave_model import HeaveModel
from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.aircraft.planning import KNOTS, TRAVEL, least_travel
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import AircraftState, Commands
from lidar_mi.aircraft.strips import Loads, wake_loads
from lidar_mi.schema.encounter import Aircraft, Path

STEP, SPEED, LENGTH, GUST = 0.02, 75.0, 100.0, 10.0
ENTRY = 3.0  # s


def heave(**keys):
    return HeaveModel(Aircraft(model="heave", heave=keys), Path(climb_angle=0.0))


def gust_on(aircraft, rolling=0.0, largest=GUST):
    """Loads over time of a vertical 1-cosine gust, and of a rolling moment (N m) with it."""
    x, normals = aircraft.strips.places[:, 0], aircraft.strips.normals

    def loads(time):
        way = SPEED * (np.asarray(time)[..., None] - ENTRY) + x
        shape = np.where((way > 0) & (way < LENGTH), (1 - np.cos(2 * np.pi * way / LENGTH)) / 2, 0)
        wind = largest * shape[..., None] * np.where(normals[:, 2:] > 0, [0.0, 0.0, 1.0], 0.0)
        found = wake_loads(aircraft.strips, wind, SPEED, aircraft.density)
        found.moment[..., 0] += rolling * shape[..., 0]
        return found

    return loads


def flown(aircraft, controller_of, loads, known=True, duration=8.0):
    """States and deflections (aileron, elevator, symmetric) of a flight."""
    controller, states, deflections = controller_of(aircraft), [], []
    for _ in range(round(duration / STEP)):
        state = aircraft.state
        commands = controller(loads if known else no_loads, state)
        states.append(aircraft.step(STEP, loads(state.time), commands))
        symmetric = getattr(aircraft, "symmetric", 0.0)
        deflections.append([*aircraft.deflection[:2], symmetric])
    return states, np.array(deflections)


def increments(states):
    return np.array([one.load_factor for one in states]) - states[0].load_factor


def least_load_factor(aircraft, loads, duration=8.0):
    """The least that controls within limits can make of the largest load factor: linear program.

    The equations by scipy, controls linear between 0.1 s.
    """
    equations, limits, dt = aircraft.heave, aircraft.limits, 0.1
    time = np.arange(0, duration, 0.02)
    knots = np.arange(0, duration, dt)
    wind = loads(time)
    inputs = np.hstack([equations.wind, equations.controls])
    system = (equations.motion, inputs, equations.motion[:1] / g, inputs[:1] / g)

    def answer(drive):
        return lsim(system, drive, time)[1].ravel()

    free = np.zeros((len(time), 4))
    free[:, :2] = np.stack([wind.force[:, 2], wind.moment[:, 1]], -1)
    alone, rows, bounds = answer(free), [], []
    for k, largest in ((2, limits.deflection[1]), (3, limits.symmetric_aileron)):
        for unit in np.eye(len(knots)):
            drive = np.zeros((len(time), 4))
            drive[:, k] = np.interp(time, knots, unit)
            rows.append(answer(drive))
            bounds.append((-largest, largest))
    response, one = np.array(rows).T, np.ones((len(time), 1))
    turns = np.kron(np.eye(2), np.diff(np.eye(len(knots)), axis=0))
    none = np.zeros((len(turns), 1))
    found = linprog(
        np.eye(response.shape[1] + 1)[-1],
        np.block([[response, -one], [-response, -one], [turns, none], [-turns, none]]),
        np.concatenate([-alone, alone, np.full(2 * len(turns), limits.rate[1] * dt)]),
        bounds=[*bounds, (0, None)],
    )
    return found.fun


def test_the_plan_is_near_the_best_possible():
    """Largest load factor: below half of that without control, a third above the least."""
    loads = gust_on(heave())
    off, ours = (
        np.abs(increments(flown(heave(), law, loads)[0])).max()
        for law in (lambda one: wings_level(one, 3.0), feedforward)
    )
    least = least_load_factor(heave(), loads)
    assert 0.98 * least < ours < 1.35 * least and ours < 0.45 * off


def test_bending_falls_with_the_load_factor():
    loads = gust_on(heave())
    off, ours, fixed = (
        max(abs(one.port_bending) for one in flown(heave(**keys), law, loads)[0])
        for law, keys in (
            (lambda one: wings_level(one, 3.0), {}),
            (feedforward, {}),
            (feedforward, {"largest_symmetric_aileron": 0.0}),
        )
    )
    # ailerons bend more than they lift
    assert ours < 0.8 * fixed < 0.6 * off


def test_controls_stay_within_their_limits():
    """A gust that rolls and lifts: each aileron within its stop and its rate."""
    loads = gust_on(heave(), rolling=1.2e6, largest=20.0)
    aircraft = heave()
    moved = flown(aircraft, feedforward, loads)[1]
    limits = aircraft.limits
    assert np.abs(moved[:, 0]).max() > 0.9 * limits.deflection[0]  # roll needs all
    assert np.abs(moved[:, 2]).max() > 0.9 * limits.symmetric_aileron
    for sign in (1, -1):
        aileron = moved[:, 2] + sign * moved[:, 0]
        assert np.abs(aileron).max() <= limits.deflection[0] + 1e-9
        assert np.abs(np.diff(aileron)).max() <= limits.rate[0] * STEP + 1e-9
    assert np.abs(moved[:, 1]).max() <= limits.deflection[1] + 1e-9
    assert np.abs(np.diff(moved[:, 1])).max() <= limits.rate[1] * STEP + 1e-9


def test_roll_comes_first():
    """The bank is that of an aircraft without symmetric ailerons."""
    loads = gust_on(heave(), rolling=1.2e6, largest=20.0)
    both, alone = (
        np.array([one.roll for one in flown(heave(**keys), feedforward, loads)[0]])
        for keys in ({}, {"largest_symmetric_aileron": 0.0})
    )
    assert np.abs(alone).max() > np.radians(1)
    # an aileron at its stop gives way at its rate
    assert np.abs(both).max() < 1.1 * np.abs(alone).max()


def test_an_autopilot_returns_to_its_path():
    """Pitched by 2 degrees, which alone would climb for ever: the climb ends."""
    aircraft = heave()
    controller = feedforward(aircraft)
    aircraft.state = AircraftState(pitch=np.radians(2), airspeed=SPEED)
    nothing = no_loads(0.0)
    climb = [
        aircraft.step(STEP, nothing, controller(no_loads, aircraft.state)).vertical_speed
        for _ in range(1000)
    ]
    assert max(climb) > 0.5 and abs(climb[-1]) < 0.1 * max(climb)
    assert abs(aircraft.state.pitch) < np.radians(0.2)


def test_a_preview_without_bending():
    """Of a user: force and moment alone."""
    loads = gust_on(heave())

    def bare(time):
        found = loads(time)
        return Loads(found.force, found.moment)

    commands = feedforward(heave())(bare, AircraftState(time=2.6, airspeed=SPEED))
    # the gust comes in 0.4 s: the nose goes down
    assert commands.elevator > 0.05


def test_an_aircraft_that_only_rolls_is_steered_in_roll():
    commands = feedforward(RollModel(Aircraft(), Path()))(gust_on(heave()), AircraftState())
    assert commands == Commands()


def test_travel_narrows_no_faster_than_the_control_moves():
    least = least_travel(0.2, np.full(KNOTS, 0.05), np.full(KNOTS, 0.03))
    path = np.maximum(0.2 - 0.03 * np.arange(1, KNOTS + 1), 0.05)
    assert (TRAVEL @ path >= least - 1e-12).all()
    assert not (TRAVEL @ (path + 1e-6) >= least - 1e-9).all()


# --- an aircraft of JSBSim --------------------------------------------------------------------


@pytest.fixture(scope="module")
def boeing():
    pytest.importorskip("jsbsim")

    def new():
        return JSBSimAircraft(Aircraft(model="737"), Path(climb_angle=0.0))

    return new


def test_equations_of_jsbsim(boeing):
    """Load factor and pitch rate in a gust: 3 % of the largest, of its six degrees of freedom."""
    aircraft = boeing()
    loads = gust_on(aircraft)
    states, _ = flown(aircraft, lambda one: lambda preview, state: Commands(), loads, duration=5.0)
    time = STEP * np.arange(len(states) + 1)
    wind = loads(time)
    drive = np.stack([wind.force[:, 2], wind.moment[:, 1]], -1)
    equations = aircraft.heave
    output = np.vstack([equations.motion[:1] / g, [[0.0, 0.0, 1.0]]])
    direct = np.vstack([equations.wind[:1] / g, [[0.0, 0.0]]])
    found = lsim((equations.motion, equations.wind, output, direct), drive, time)[1][:-1]
    flight = np.array([[one.load_factor, one.pitch_rate] for one in states])
    # loads act one step of 1/60 s later there
    for k in (0, 1):
        scale = np.abs(found[:, k]).max()
        np.testing.assert_allclose(flight[:, k] - flight[0, k], found[:, k], atol=0.05 * scale)
    # from the derivatives of its file: C_m_q -27 and C_m_alpha' -16
    unit = 0.5 * aircraft.density * SPEED * 108.8 * 3.752**2 / 2
    inertia = 1 / -equations.wind[2, 1]
    assert -equations.motion[2, 2] * inertia == pytest.approx(43 * unit, rel=0.02)


@pytest.mark.slow
def test_the_elevator_of_jsbsim_alleviates(boeing):
    """It has no symmetric ailerons; its bending follows the load factor."""
    loads = gust_on(boeing(), largest=6.0)
    off, (ours, moved) = (
        flown(boeing(), law, loads, duration=6.0)
        for law in (lambda one: wings_level(one, 3.0), feedforward)
    )
    assert np.abs(increments(ours)).max() < 0.7 * np.abs(increments(off[0])).max()
    assert boeing().limits.symmetric_aileron == 0 and not moved[:, 2].any()
    bent = [max(abs(one.port_bending) for one in states) for states in (off[0], ours)]
    assert bent[1] < 0.75 * bent[0] and bent[0] > 2e5
