"""Faults that pydantic finds in a description, in the terms of its author."""

import difflib
import enum
import re
from collections.abc import Iterator
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from lidar_mi.schema.section import metadata_of, section_in, tagged_section
from lidar_mi.units import Unit, Within, to_si

A_NAME = "at most 100 letters, digits, _, . and -, a letter or digit first"
"""The names that the pattern allows."""


def first_fault(error: ValidationError, model: type[BaseModel]) -> str:
    """The key of the first fault in a description, its value and what is allowed, as one line.

    model (type of BaseModel): of the description: it says units, limits and the keys of every
        section.
    """
    faults = error.errors()
    # a misspelt key also leaves one missing: report the misspelt one
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    where, word = _key(model, fault["loc"]), ""
    alternatives = [f for f in faults if f is not fault and _key(model, f["loc"]) == where]
    if alternatives and fault["type"] == "literal_error":
        # a word or a number: report the number's fault
        word = fault["ctx"]["expected"] + " or "
        fault = alternatives[0]
    field = ".".join(where)
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        allowed = _keys_at(model, fault["loc"][:-1])
        longer = [key for key in allowed if key.startswith(f"{where[-1]}_")]
        close = longer or difflib.get_close_matches(where[-1], allowed, 1)
        hint = f"; did you mean {' or '.join(close)}?" if close else ""
        return f"{field}: unknown key{hint} (allowed: {', '.join(allowed)})"
    if fault["type"] == "missing":
        return f"{field}: missing"
    if fault["type"] == "value_error":
        return f"{field}: {message}" if field else message
    value = fault["input"]
    key = _field_at(model, fault["loc"])
    unit, within = (metadata_of(key, kind) for kind in (Unit, Within))
    symbol = unit.symbol if unit else ""
    text = f"{value:g} {symbol}".strip() if isinstance(value, float) else repr(value)
    if fault["type"] in ("out_of_range", "finite_number", "int_parsing_size") and within:
        if unit and not isinstance(value, float):
            # the interpreted value, with its unit
            text = f"{to_si(value, symbol, unit.example):g} {symbol}".strip()
        expected = word + within.words(symbol)
        if symbol == "rad" and isinstance(value, str):
            # angles in the unit in which they were given
            angle = re.fullmatch(r"\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?\s*([a-zA-Z]+)\s*", value)
            if angle:
                text = " ".join(value.split())
                size = to_si(f"1 {angle[1]}", symbol, unit.example)
                expected = word + within.words(angle[1], 1 / size)
    elif fault["type"].startswith("model_"):
        expected = f"a section with keys out of {', '.join(_keys_at(model, fault['loc']))}"
    elif fault["type"] == "string_pattern_mismatch":
        expected = A_NAME
    elif fault["type"] in ("tuple_type", "list_type"):
        count = _length_at(model, fault["loc"])
        example = ", ".join([str(value)] * count) if isinstance(value, str | int | float) else ""
        words = _words_at(model, fault["loc"])
        if words and value not in words:
            expected = f"a list in brackets of {', '.join(words)}"
        else:
            expected = "a list in brackets" + (f": [{example}]" if example else "")
    elif fault["type"] == "too_short":
        expected = f"{fault['ctx']['min_length']} or more"
    else:
        expected = word + message.removeprefix("Input should be ")
    return f"{field}: {text} is not allowed; expected {expected}"


def _steps(
    model: type[BaseModel], location: tuple[int | str, ...]
) -> Iterator[tuple[int | str, Any, Any, bool]]:
    """Each part of a location, with its field and section, and whether it is a tag."""
    field: Any = None
    section: Any = model
    for part in location:
        tagged = tagged_section(field.annotation, part) if field else None
        if tagged:
            section = tagged
        elif section and part in section.model_fields:
            field = section.model_fields[part]
            section = section_in(field.annotation)
        yield part, field, section, tagged is not None


def _field_at(model: type[BaseModel], location: tuple[int | str, ...]) -> Any:
    """The field of the key at a location; None: there is none."""
    return next((field for _, field, _, _ in reversed([*_steps(model, location)])), None)


def _key(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """A fault's location without the kinds of value that pydantic tried there."""
    kinds = ("literal[", "function-")
    return [
        str(part)
        for part, _, _, is_tag in _steps(model, location)
        if not is_tag and part != "float" and not str(part).startswith(kinds)
    ]


def _length_at(model: type[BaseModel], location: tuple[int | str, ...]) -> int:
    """How many values a list at a location has; 1: any number."""
    field = _field_at(model, location)
    annotation: Any = field.annotation if field else None
    for kind in (annotation, *get_args(annotation)):
        if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
            return len(get_args(kind))
    return 1


def _words_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The words allowed in the list at a location; empty: its members are no words."""
    field = _field_at(model, location)
    members = get_args(field.annotation) if field else ()
    kind = members[0] if members else None
    words: tuple[Any, ...] = tuple(kind) if isinstance(kind, enum.EnumType) else ()
    return [str(member) for member in words]


def _keys_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    section = next((s for _, _, s, _ in reversed([*_steps(model, location)])), model)
    return list(section.model_fields)
