"""A controller of the user, whose errors become one line with its name."""

import functools
import inspect
import math
import traceback
from collections.abc import Callable
from numbers import Real
from pathlib import Path
from typing import Any

from lidar_mi.aircraft.control import Controller, Preview
from lidar_mi.aircraft.state import AircraftModel, AircraftState, Commands
from lidar_mi.errors import InputError

_MAKER = "expected a function of the aircraft that returns a controller"
_CONTROLLER = "expected a function of the preview and the state that returns Commands"


def name_of(maker: Callable[..., Any]) -> str:
    """Name of a controller in tables, figures and messages."""
    while isinstance(maker, functools.partial):
        maker = maker.func
    name = getattr(maker, "__name__", type(maker).__name__)
    return "own controller" if name == "<lambda>" else name


def user_controller(maker: Callable[..., Any], aircraft: AircraftModel) -> Controller:
    """The controller that a function ``maker`` makes for an aircraft, checked at every call.

    Raises InputError: it takes other arguments, raises an exception, or returns no controller; the
    controller itself when it is called: other arguments, an exception, no `Commands` of finite
    numbers.
    """
    called = f"controller {name_of(maker)}"
    if not _accepts(maker, 1):
        given, hint = "other arguments", ""
        if _accepts(maker, 2):
            given = "a controller itself, of the preview and the state"
            hint = ": lambda aircraft: the controller"
        raise InputError(f"{called}: takes {given}; {_MAKER}{hint}")
    try:
        made = maker(aircraft)
    except Exception as error:
        raise InputError(f"{called}: {_with_line(error)}; {_MAKER}") from error
    if not callable(made):
        raise InputError(f"{called}: returned {_shown(made)} for an aircraft; {_MAKER}")
    if not _accepts(made, 2):
        raise InputError(f"{called}: what it returned takes other arguments; {_CONTROLLER}")

    def controller(preview: Preview, state: AircraftState) -> Commands:
        try:
            commands = made(preview, state)
        except Exception as error:
            raise InputError(
                f"{called}: {_with_line(error)} at {state.time:.2f} s of flight"
            ) from error
        if not isinstance(commands, Commands):
            raise InputError(f"{called}: returned {_shown(commands)}; expected Commands(aileron=…)")
        for control, value in vars(commands).items():
            if not (isinstance(value, Real) and math.isfinite(value)):
                raise InputError(
                    f"{called}: Commands.{control}: {_shown(value)} at {state.time:.2f} s of "
                    "flight; expected a finite number, rad"
                )
            if abs(float(value)) > math.pi / 2:
                raise InputError(
                    f"{called}: Commands.{control}: {value:g} rad at {state.time:.2f} s of flight "
                    "is not allowed; expected at most 1.57 rad (are these degrees?)"
                )
        return commands

    return controller


def _accepts(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments; unknown ones are tried."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # functions in C have no signature
        return True
    return True


def _with_line(error: Exception) -> str:
    """An exception with the line of the user's file that raised it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    words = " ".join(str(error).split())[:120]
    name = type(error).__name__
    return f"{name}{': ' if words else ''}{words} ({Path(last.filename).name}:{last.lineno})"


def _shown(value: object) -> str:
    text = " ".join(repr(value).split())
    return f"{text} ({type(value).__name__})" if len(text) < 50 else type(value).__name__
