"""A controller of one's own. Detects a fault of it that is no one line, or does not name it."""

import functools

import pytest

import lidar_mi as lm
from lidar_mi.aircraft.state import Commands
from lidar_mi.aircraft.user_controller import name_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import encounter_keys


def steers(preview, state):
    return Commands(aileron=0.1)


def half(aircraft):
    return steers


def number(aircraft):
    return lambda preview, state: 0.1


def late(aircraft):
    def controller(preview, state):
        raise ZeroDivisionError("division by zero")

    return controller


def fly(controller):
    one = check(
        encounter_keys(control={"mode": "perfect"}, path={"start": "20 m", "beyond": "5 m"}), "test"
    )
    return lm.fly(one, controller=controller, notice=silent)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (number, "controller number: returned 0.1 (float); expected Commands"),
        (steers, "controller steers: takes a controller itself, of the preview and the state; exp"),
        (lambda: steers, "controller own controller: takes other arguments; expected a function"),
        (lambda aircraft: 3, "returned 3 (int) for an aircraft"),
        (lambda aircraft: aircraft.flaps, "AttributeError: "),
        (lambda aircraft: half, "what it returned takes other arguments"),
        (late, "controller late: ZeroDivisionError: division by zero (test_user_controller.py:"),
        (
            lambda aircraft: lambda preview, state: Commands(aileron=float("nan")),
            "Commands.aileron: nan (float) at 0.00 s of flight; expected a finite number, rad",
        ),
        (
            lambda aircraft: lambda preview, state: Commands(aileron=-20.0),
            "Commands.aileron: -20 rad at 0.00 s of flight is not allowed; expected at most 1.57",
        ),
    ],
)
def test_faults_are_one_line_that_names_the_controller(controller, message):
    with pytest.raises(InputError) as stop:
        fly(controller)
    assert message in str(stop.value) and "\n" not in str(stop.value)


def test_its_name_stands_where_the_autopilot_s_does():
    flight = fly(half)
    assert flight.series.attrs["controller"] == "half"
    shown = str(flight)
    assert "half, no preview" in shown and "autopilot" not in shown
    assert "degrees (half, no preview)" in flight.answer[0]
    assert name_of(functools.partial(late)) == "late"
    assert "autopilot" in str(fly(None))
