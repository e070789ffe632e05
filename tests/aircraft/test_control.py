"""Steering with a perfect preview: what a linear aircraft still feels.

Detects a wrong sign or size of the commands, a command beyond the limits, a controller that does
not start early, a plan that is far from the best possible, an aileron that jumps when the preview
is lost.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

from lidar_mi.aircraft.control import (
    bumpless_transfer,
    cancelling,
    feedforward,
    no_loads,
    wings_level,
)
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import AircraftState, Commands, loads_in_wind
from lidar_mi.aircraft.strips import Loads
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.schema.encounter import Aircraft, Path

STEP = 1 / 30
CROSSING = np.tan(np.radians(10))


def wake(circulation):
    """A pair at rest whose port vortex crosses the path at x = 300 m under 10 degrees."""
    pair = vortex_pair(circulation, 47.0, 3.0)

    def wind(x, y, z, time):
        v, w = velocity(pair, y - (x - 300.0) * CROSSING + 23.5, z)
        return 0 * v, v, w

    return wind


def simulated(controller_of, wind, aircraft=None, duration=6.5):
    """Roll, roll rate and aileron over time."""
    model = RollModel(aircraft or Aircraft(), Path())
    controller = controller_of(model)
    rows = []
    for _ in range(round(duration / STEP)):
        state = model.state

        def preview(time, state=state):
            return loads_in_wind(model.strips, state, wind, model.density, time)

        commands = controller(preview, state)
        model.step(STEP, preview(state.time), commands)
        rows.append((model.state.roll, model.state.roll_rate, model.deflection[0]))
    return np.array(rows).T


def test_cancelling_leaves_nothing_with_an_unlimited_aileron():
    aircraft = Aircraft(largest_aileron="1 rad", aileron_rate="100 rad/s", aileron_power=1.0)
    off = simulated(lambda model: wings_level(model, None), wake(350), aircraft)
    steered = simulated(lambda model: cancelling(model, None), wake(350), aircraft)
    assert np.abs(off[0]).max() > np.radians(20)
    assert np.abs(steered[0]).max() < 1e-4 * np.abs(off[0]).max()


@pytest.mark.parametrize("law", [lambda model: cancelling(model, 3.0), feedforward])
def test_commands_stay_within_the_limits(law):
    aileron = simulated(law, wake(350))[2]
    assert np.abs(aileron).max() <= np.radians(20) * (1 + 1e-9)
    assert np.abs(np.diff(aileron)).max() <= np.radians(50) * STEP * (1 + 1e-9)


def least_largest_roll(wind, duration=6.5):
    """The least that any aileron within its limits can make of the largest roll: a linear program.

    Roll and rate by the matrix exponential of the equation, the aileron linear between 0.1 s.
    """
    model = RollModel(Aircraft(), Path())
    dt, count = 0.1, round(duration / 0.1)
    flow = np.zeros((4, 4))  # of roll, rate, moment, its slope
    flow[0, 1] = flow[2, 3] = 1.0
    flow[1, 1:3] = model.roll_damping / 8e5, 1 / 8e5
    step = expm(flow * dt)
    answer = np.zeros((2, count + 1))
    rows = []
    for k in range(count):
        slope = (np.eye(count + 1)[k + 1] - np.eye(count + 1)[k]) / dt
        answer = step[:2, :2] @ answer + np.outer(step[:2, 2], np.eye(count + 1)[k])
        answer = answer + np.outer(step[:2, 3], slope)
        rows.append(answer[0])
    response = np.array(rows)
    instants = dt * np.arange(count + 1)
    loads = loads_in_wind(model.strips, model.state, wind, model.density, instants)
    moments = loads.moment[:, 0]
    wake_roll, power = response @ moments, model.control_moments[0, 0]
    turns = np.diff(np.eye(count + 1), axis=0)
    one, none = np.ones((count, 1)), np.zeros((count, 1))
    steered = power * response
    found = linprog(
        np.eye(count + 2)[-1],
        np.block([[steered, -one], [-steered, -one], [turns, none], [-turns, none]]),
        np.concatenate([-wake_roll, wake_roll, np.full(2 * count, np.radians(50) * dt)]),
        bounds=[(0, 0)] + [(-np.radians(20), np.radians(20))] * count + [(0, None)],
    )
    return found.fun


def test_the_plan_is_near_the_best_possible():
    """Twice as much as the least, or below; cancelling alone leaves three times as much."""
    wind = wake(350)
    off, planned, cancelled = (
        np.abs(simulated(law, wind)[0]).max()
        for law in (
            lambda model: wings_level(model, 3.0),
            lambda model: feedforward(model),
            lambda model: cancelling(model, 3.0),
        )
    )
    least = least_largest_roll(wind)
    assert 0.98 * least < planned < 2 * least and planned < 0.3 * off
    assert 3 * least < cancelled < 0.6 * off


def test_a_plan_without_loads_levels_the_wings():
    """An autopilot: from 10 degrees of bank to below 1 in 3 s, without going beyond."""
    model = RollModel(Aircraft(), Path())
    controller = feedforward(model)
    while model.state.roll < np.radians(10):
        model.step(STEP, Loads(np.zeros(3), np.array([3e5, 0.0, 0.0])), Commands())
    for _ in range(90):
        model.step(STEP, no_loads(0.0), controller(no_loads, model.state))
    assert abs(model.state.roll) < np.radians(1)


def test_a_slow_control_starts_early():
    """A moment that appears at once is met half way: the aileron moves before and after it."""
    aircraft = Aircraft(aileron_rate="20 deg/s")
    model = RollModel(aircraft, Path())
    controller = cancelling(model, None)
    moment = np.radians(10) * model.control_moments[0, 0]

    def preview(time):
        rolling = np.where(np.asarray(time) > 1, -moment, 0.0)[..., None] * [1.0, 0.0, 0.0]
        return Loads(0 * rolling, rolling)

    deflections = []
    for _ in range(60):
        model.step(STEP, preview(model.state.time), controller(preview, model.state))
        deflections.append(model.deflection[0])
    at_one = deflections[29]
    # half an instant of the horizon (2 s in 8 intervals) is what the look ahead resolves
    assert at_one == pytest.approx(np.radians(5), abs=np.radians(20) * 0.125)
    assert deflections[-1] == pytest.approx(np.radians(10))
    assert np.all(np.diff(deflections) > -1e-12)


def test_levelling_decays_with_its_time():
    """Slow against the roll mode: the bank angle goes as exp(-t / time)."""
    model = RollModel(Aircraft(), Path())
    controller = wings_level(model, 20.0)
    model.step(0.5, Loads(np.zeros(3), np.array([2e5, 0.0, 0.0])), Commands())
    nothing = no_loads(0.0)
    rolls = [model.step(STEP, nothing, controller(no_loads, model.state)).roll for _ in range(300)]
    assert np.log(rolls[149] / rolls[299]) == pytest.approx(150 * STEP / 20, rel=0.05)


def test_nothing_steers_without_a_time():
    assert wings_level(RollModel(Aircraft(), Path()), None)(no_loads, AircraftState(roll=0.3)) == (
        Commands()
    )


# --- a preview that is lost -------------------------------------------------------------------


def constant(moment):
    """A preview of one rolling moment at all times."""

    def preview(time):
        rolling = np.full((*np.shape(time), 3), [moment, 0.0, 0.0])
        return Loads(2 * rolling, rolling)

    return preview


def test_a_lost_preview_fades():
    """Linearly over the horizon; before the first one there are no loads; a new one is itself."""
    transfer, times = bumpless_transfer(), np.array([3.0, 3.5])

    def loads(preview, time):
        return transfer(preview, AircraftState(time=time))(times)

    assert not loads(None, 0.0).moment.any()
    assert transfer(no_loads, AircraftState()) is no_loads
    np.testing.assert_allclose(loads(constant(8.0), 1.0).moment[:, 0], 8.0)
    for time, expected in ((1.5, 6.0), (2.0, 4.0), (2.9, 0.4), (3.0, 0.0), (9.0, 0.0)):
        found = loads(None, time)
        np.testing.assert_allclose(found.moment, [[expected, 0, 0]] * 2, atol=1e-12)
        np.testing.assert_allclose(found.force, 2 * found.moment)
    again = constant(5.0)
    assert transfer(again, AircraftState(time=3.1)) is again


def test_an_aileron_that_holds_does_not_let_go():
    """A moment is held in balance, and the preview is lost: the command follows without a jump.

    In a step the command changes by less than the actuator can move; with the loads gone at once
    it jumps by the way of an interval of the plan.
    """
    moment = np.radians(12) * RollModel(Aircraft(), Path()).control_moments[0, 0]
    dt, jumps, rolls = 0.01, {}, {}
    for name in ("at once", "bumpless"):
        model = RollModel(Aircraft(), Path())
        controller, transfer = feedforward(model), bumpless_transfer()
        commands, bank = [], []
        for step in range(600):
            lost = step >= 300
            preview = None if lost else constant(-moment)
            if name == "at once":
                chosen = no_loads if lost else constant(-moment)
            else:
                chosen = transfer(preview, model.state)
            commands.append(controller(chosen, model.state))
            model.step(dt, constant(-moment)(0.0), commands[-1])
            bank.append(model.state.roll)
        ailerons = [one.aileron for one in commands]
        assert ailerons[299] == pytest.approx(np.radians(12), rel=0.02)
        jumps[name], rolls[name] = np.abs(np.diff(ailerons[295:])).max(), np.abs(bank[300:505])
    assert jumps["bumpless"] < model.limits.rate[0] * dt < 0.2 * jumps["at once"]
    # while it fades
    assert rolls["bumpless"].max() < rolls["at once"].max()
