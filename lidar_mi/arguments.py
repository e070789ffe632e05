"""Arguments of public functions: of the types that their annotations say."""

import functools
import inspect
import operator
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar

from lidar_mi.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

_WORDS = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "True or False",
    types.NoneType: "None",
    Any: "anything",
    Path: "a path (255 bytes a name)",
}


def checked_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments of other types than its annotations, each by its name.

    Whether a value is in range is for the function to say.
    """
    signature, annotations = inspect.signature(function), function.__annotations__
    hints: dict[str, Any] = {}

    @functools.wraps(function)
    def checked(*given: P.args, **named: P.kwargs) -> R:
        if not hints:
            asked = {name: kind for name, kind in annotations.items() if name != "return"}
            holder = types.SimpleNamespace(__annotations__=asked)
            hints.update(typing.get_type_hints(holder, function.__globals__))
        for name, value in signature.bind(*given, **named).arguments.items():
            expected = hints.get(name, Any)
            more = signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD
            for key, one in value.items() if more else [(name, value)]:
                _check(key, one, expected)
        return function(*given, **named)

    return checked


def check_fields(description: object) -> None:
    """Raise an `InputError` unless the fields of a dataclass are of the types it annotates."""
    for name, expected in typing.get_type_hints(type(description)).items():
        _check(name, getattr(description, name), expected)


def _check(name: str, value: Any, expected: Any) -> None:
    if not _is(value, expected):
        raise InputError(f"{name}: {_shown(value)} is not allowed; expected {_in_words(expected)}")


def _is(value: Any, annotation: Any) -> bool:
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is Any:
        return True
    if origin in (typing.Union, types.UnionType):
        named = Path in inner and isinstance(value, str | Path)
        return any(_is(value, part) for part in inner) and not (named and not _nameable(value))
    if origin is Literal:
        return isinstance(value, tuple(map(type, inner)))
    if origin is tuple:
        listed = hasattr(value, "__len__") and not isinstance(value, str | bytes | Mapping)
        return listed and len(value) == len(inner) and all(map(_is, value, inner))
    if origin is Sequence:
        return isinstance(value, list | tuple) and all(_is(one, inner[0]) for one in value)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(_is(one, inner[1]) for one in value.values())
    if origin is Callable:
        return callable(value)
    if annotation is float:
        return not isinstance(value, str | bytes | bool) and _becomes(float, value)
    if annotation is int:
        return not isinstance(value, bool) and _becomes(operator.index, value)
    return isinstance(value, annotation)


def _nameable(path: str | Path) -> bool:
    """Whether a file may have that path: no NUL, names within what file systems allow."""
    name = os.fsencode(path) if isinstance(path, Path) else path.encode(errors="replace")
    return b"\0" not in name and len(name) < 4096 and max(map(len, name.split(b"/"))) <= 255


def _becomes(kind: Callable[[Any], Any], value: Any) -> bool:
    try:
        kind(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def _in_words(annotation: Any) -> str:
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_in_words, inner)))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return f"({', '.join(map(_in_words, inner))})"
    if origin is Sequence:
        return f"a list of {_in_words(inner[0])}"
    if origin is Mapping:
        return f"a mapping to {_in_words(inner[1])}"
    if origin is Callable:
        return "a function"
    return _WORDS.get(annotation) or annotation.__name__


def _shown(value: Any) -> str:
    """A value if it is short, else of which type it is."""
    if isinstance(value, str | bytes | float | complex | types.NoneType):
        return repr(value[:50] if isinstance(value, str | bytes) else value)
    if isinstance(value, int) and abs(value) < 10**50:
        return repr(value)
    return type(value).__name__
