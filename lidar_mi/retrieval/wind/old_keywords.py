"""Keywords of version 0.1, which took sizes and thresholds one by one."""

import functools
import inspect
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, ParamSpec, TypeVar, cast

from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, type[WindowSizes] | type[VectorValidation]] = {
    "windows": WindowSizes,
    "validation": VectorValidation,
}
# What followed the method by position.
_AFTER_METHOD = ("template", "search", "stride", "device")


def with_old_keywords(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function of `windows` and `validation` take their fields as keywords, with a warning.

    A function that takes a method also takes the sizes and the device by position after it.
    """
    parameters = inspect.signature(function).parameters
    places = [one for one in parameters.values() if one.kind is one.POSITIONAL_OR_KEYWORD]

    @functools.wraps(function)
    def called(*given: Any, **named: Any) -> R:
        now: dict[str, Any] = {}
        if "method" in parameters:
            named |= dict(zip(_AFTER_METHOD, given[len(places) :], strict=False))
            given = given[: len(places)]
        for name, kind in _OPTIONS.items():
            old = {f.name: named.pop(f.name) for f in fields(kind) if f.name in named}
            if old:
                default = parameters[name].default if name in parameters else kind()
                now[name] = replace(named.pop(name, default), **old)
                shown = ", ".join(f"{field}={value!r}" for field, value in old.items())
                warnings.warn(
                    f"{function.__name__}: {', '.join(old)} by itself goes with the next version; "
                    f"write {name}=lm.{kind.__name__}({shown})",
                    DeprecationWarning,
                    stacklevel=2,
                )
        return function(*given, **named, **now)

    return cast("Callable[P, R]", called)
