"""Reading plugin parameters: a wrong value is named with its plugin, field and what is allowed."""

import math

import mitsuba as mi
import numpy as np


def fail(plugin: str, field: str, value, allowed: str):
    """Raise ValueError: ``plugin.field: value is not allowed; expected ...``."""
    raise ValueError(f"{plugin}.{field}: {value!r} is not allowed; expected {allowed}")


def positive(props, plugin: str, field: str, default: float) -> float:
    """The float parameter ``field``, greater than zero."""
    value = float(props.get(field, default))
    if not value > 0:
        fail(plugin, field, value, "a number above 0")
    return value


def at_least(props, plugin: str, field: str, default: float, least: float) -> float:
    """The finite float parameter ``field``, no smaller than ``least``."""
    value = float(props.get(field, default))
    if not (value >= least and math.isfinite(value)):
        fail(plugin, field, value, f"a finite number of at least {least:g}")
    return value


def whole(props, plugin: str, field: str, default: int, least: int) -> int:
    """The integer parameter ``field``, no smaller than ``least``."""
    value = int(props.get(field, default))
    if value < least:
        fail(plugin, field, value, f"a whole number of at least {least}")
    return value


def choice(props, plugin: str, field: str, default: str, allowed: tuple[str, ...]) -> str:
    """The string parameter ``field``, one of ``allowed``."""
    value = props.get(field, default)
    if value not in allowed:
        fail(plugin, field, value, "one of " + ", ".join(allowed))
    return value


def pose(props, field: str = "to_world"):
    """The transform parameter ``field`` in the variant's precision; Mitsuba reads doubles."""
    if not props.has_property(field):
        return mi.Transform4f()
    return mi.Transform4f(np.array(props[field].matrix, dtype=np.float32))
