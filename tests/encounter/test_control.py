"""Steering with a perfect preview: what a linear aircraft still feels.

Detects a wrong sign or size of the commands, a command beyond the limits, a controller that does
not start early, levelling that differs between the modes.
"""

import numpy as np
import pytest

from lidar_mi.atmosphere.vortex import velocity, vortex_pair
from lidar_mi.encounter.aircraft import Commands, flown_on, loads_in_wind
from lidar_mi.encounter.control import feedforward, wings_level
from lidar_mi.encounter.roll_model import RollModel
from lidar_mi.encounter.strips import Loads
from lidar_mi.experiment.schema_encounter import Aircraft, Path

STEP = 1 / 30
CROSSING = np.tan(np.radians(10))


def wake(circulation):
    """A pair at rest whose port vortex crosses the path at x = 300 m under 10 degrees."""
    pair = vortex_pair(circulation, 47.0, 3.0)

    def wind(x, y, z, time):
        v, w = velocity(pair, y - (x - 300.0) * CROSSING + 23.5, z)
        return 0 * v, v, w

    return wind


def flown(controller_of, wind, aircraft=None, duration=6.5):
    """Roll, roll rate and aileron over time."""
    model = RollModel(aircraft or Aircraft(), Path())
    controller = controller_of(model)
    rows = []
    for _ in range(round(duration / STEP)):
        state = model.state

        def preview(time, state=state):
            there = flown_on(state, time)
            return loads_in_wind(model.strips, there, wind, model.density)

        commands = controller(preview, state)
        model.step(STEP, preview(state.time), commands)
        rows.append((model.state.roll, model.state.roll_rate, model.deflection[0]))
    return np.array(rows).T


def test_nothing_is_left_with_an_unlimited_aileron():
    aircraft = Aircraft(largest_aileron="1 rad", aileron_rate="100 rad/s", aileron_power=1.0)
    off = flown(lambda model: wings_level(model, None), wake(350), aircraft)
    steered = flown(lambda model: feedforward(model, None), wake(350), aircraft)
    assert np.abs(off[0]).max() > np.radians(20)
    assert np.abs(steered[0]).max() < 1e-4 * np.abs(off[0]).max()


def test_commands_stay_within_the_limits_and_help():
    off = flown(lambda model: wings_level(model, 3.0), wake(350))
    roll, _, aileron = flown(lambda model: feedforward(model, 3.0), wake(350))
    limit, rate = np.radians(20), np.radians(50)
    assert np.abs(aileron).max() <= limit * (1 + 1e-12)
    assert np.abs(np.diff(aileron)).max() <= rate * STEP * (1 + 1e-9)
    assert np.abs(roll).max() < 0.6 * np.abs(off[0]).max()


def test_a_slow_control_starts_early():
    """A moment that appears at once is met half way: the aileron moves before and after it."""
    aircraft = Aircraft(aileron_rate="20 deg/s")
    model = RollModel(aircraft, Path())
    controller = feedforward(model, None)
    moment = np.radians(10) * model.control_moments[0, 0]

    def preview(time):
        return Loads(np.zeros(3), np.array([-moment if time > 1 else 0.0, 0.0, 0.0]))

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
    nothing = Loads(np.zeros(3), np.zeros(3))
    rolls = [model.step(STEP, nothing, controller(None, model.state)).roll for _ in range(300)]
    assert np.log(rolls[149] / rolls[299]) == pytest.approx(150 * STEP / 20, rel=0.05)


def test_without_a_preview_every_mode_is_the_same():
    model = RollModel(Aircraft(), Path())
    state = model.step(0.5, Loads(np.zeros(3), np.array([2e5, 0.0, 0.0])), Commands())
    assert feedforward(model, 3.0)(None, state) == wings_level(model, 3.0)(None, state)
    assert wings_level(model, None)(None, state) == Commands()
