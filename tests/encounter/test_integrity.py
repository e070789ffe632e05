"""A preview that the measured roll contradicts is withdrawn; a right one is not.

Detects a lidar that rolls an aircraft by a wake that is not there, an alarm that comes late, false
alarms beyond those stated, a preview that stays withdrawn.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lidar_mi.aircraft.control import feedforward, no_loads
from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.aircraft.state import AircraftState
from lidar_mi.aircraft.strips import Loads
from lidar_mi.encounter.ahead.preview import preview_in
from lidar_mi.encounter.flight import simulate_flight
from lidar_mi.encounter.integrity import FALSE_ALARMS, PREDICTION_ERROR, Integrity
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import encounter_keys


def met(circulation=350.0, **miss):
    path = {"start": "250 m", "beyond": "130 m", "crossing_angle": "10 deg", "miss": miss}
    keys = encounter_keys(path=path)
    pair = {"separation": 47.1, "core_radius": 3, "width": 120, "height": 80}
    keys["wake"]["vortex_pair"] = pair | {"circulation": circulation}
    experiment = check(keys, "test")
    return experiment.encounter, wake_along_path(experiment)


class Opposite:
    """A wake of the opposite sense."""

    def __init__(self, wake):
        self.wind = lambda *at: tuple(-one for one in wake.wind(*at))


@pytest.fixture(scope="module")
def predicted():
    return met()[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        "half",
        *(
            pytest.param(c, marks=pytest.mark.slow)
            for c in ("aside", "above", "absent", "opposite")
        ),
    ],
)
def test_a_wrong_wake_costs_no_more_than_half_a_degree(predicted, case):
    """350 m2/s is predicted. At most half a degree more than with the autopilot."""
    encounter, wake = {
        "half": partial(met, 175.0),
        "aside": partial(met, y=6.0),
        "above": partial(met, z=-10.0),
        "absent": partial(met, 1.0),
        "opposite": met,
    }[case]()
    wake = Opposite(wake) if case == "opposite" else wake
    rolls = []
    for tested in (False, True):
        aircraft = aircraft_of(encounter)
        found = simulate_flight(
            aircraft,
            feedforward(aircraft),
            wake,
            encounter,
            silent,
            preview_at=partial(preview_in, predicted.wind, aircraft)
            if tested
            else lambda _: no_loads,
            integrity=Integrity(aircraft) if tested else None,
        )
        rolls.append(math.degrees(float(np.abs(found["roll"]).max())))
    expected = np.abs(found["predicted_roll_moment"].values)
    strong = found["time"].values[expected > 0.5 * expected.max()][0]
    withdrawn = found["time"].values[found["preview_withdrawn"].values > 0]
    assert rolls[1] <= rolls[0] + 0.5
    assert withdrawn[0] < strong + 0.5


def fed(integrity, measured, predicted):
    """Whether the preview is withdrawn after each independent sample of moments (N m)."""
    aircraft, control, out = integrity.aircraft, 0.0, []
    period = np.abs(aircraft.strips.places[:, 1]).max() / aircraft.state.airspeed
    integrity.checked(None, aircraft.state, control)
    for number, (moment, expected) in enumerate(zip(measured, predicted, strict=True), 1):
        # without a roll rate the wind and the controls balance
        control = -2 * moment - control
        state = replace(AircraftState(airspeed=aircraft.state.airspeed), time=number * period)
        loads = Loads(np.zeros(3), np.array([expected, 0.0, 0.0]))
        integrity.checked(lambda _, loads=loads: loads, state, control)
        out.append(integrity.withdrawn)
    return np.array(out)


def test_time_to_the_alarm_and_back():
    """Nothing of a predicted moment M, then all: each sample adds or removes M^2 / 2 s^2."""
    aircraft = aircraft_of(met()[0])
    moment = 0.5 * aircraft.control_moments[0, 0] * aircraft.limits.deflection[0]
    variance = (0.02**2 + PREDICTION_ERROR**2) * moment**2
    needed = math.ceil(math.log(1 / FALSE_ALARMS) * 2 * variance / moment**2)
    count = 3 * needed
    measured = np.repeat([0.0, moment], count)
    found = fed(Integrity(aircraft), measured, np.full(2 * count, moment))
    assert np.flatnonzero(found)[0] == needed - 1
    assert np.flatnonzero(found)[-1] == count + needed - 2


def test_false_alarms_are_as_stated():
    """40 000 samples of a right prediction in errors as stated: at most 4 alarms in the mean."""
    aircraft = aircraft_of(met()[0])
    moment = 0.5 * aircraft.control_moments[0, 0] * aircraft.limits.deflection[0]
    random, alarms = np.random.default_rng(1), 0
    for _ in range(40):
        predicted = moment * random.choice([0.3, 1.0], 1000)
        predicted[0] = moment
        error = moment * math.hypot(PREDICTION_ERROR, 0.02)
        found = fed(
            Integrity(aircraft), predicted + error * random.standard_normal(1000), predicted
        )
        alarms += int((np.diff(found.astype(int)) > 0).sum())
    # Poisson: 10 or more have a probability of 1 %
    assert alarms < 10
