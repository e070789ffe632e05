"""The keys of an experiment file in words: what each does, its unit, its default, what is allowed.

It is read from the models that check a file.
"""

import difflib
import inspect
import math
import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

from annotated_types import Ge
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lidar_mi.errors import InputError
from lidar_mi.io.yaml import to_yaml_line
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.faults import A_NAME
from lidar_mi.schema.section import metadata_of, section_in, sections_in, tagged_section
from lidar_mi.units import Unit, Within, usual

OF_A_FILE = {
    "base": "the experiment file, or the name of a shipped experiment, that this file changes: its "
    "keys are merged over those of the base, and null removes a section",
    "variants": "several experiments in one file: names, each with the keys that it changes",
}
"""Keys of a file that are not keys of an experiment."""

_MOST_SUGGESTED = 4


@dataclass(frozen=True)
class Key:
    """A key or a section of an experiment file; texts as a file would have them."""

    name: str
    meaning: str
    unit: str
    value: object
    """Default as it is described: text, or a number in the unit."""
    allowed: str
    words: tuple[str, ...]
    """Values that are words, if it takes any."""
    more: tuple[str, ...]
    """Paragraphs of its section about it; for a section, all of them."""
    keys: tuple[str, ...]
    """Names of the keys of a section."""
    listed_in: str
    """The list of sections of which this is a key; empty: none."""

    @property
    def default(self) -> str:
        """The default; empty: those of a section's keys."""
        if self.value is PydanticUndefined:
            return "required"
        return "" if isinstance(self.value, BaseModel) else _as_in_a_file(self.value, self.unit)

    @property
    def example(self) -> str:
        """How ``--set`` changes it; empty: it cannot, or the key takes any text."""
        if self.keys or self.listed_in:
            return ""
        other = [word for word in self.words if word != self.default]
        value = other[0] if other else self.default
        if value in ("required", "null") or not value:
            return ""
        return f"--set {self.name}={shlex.quote(value)}"


def names() -> list[str]:
    """Dotted names of all keys and sections, in the order of the sections."""
    return list(_fields())


def settable() -> list[str]:
    """Keys that ``--set`` can change: no sections, nor keys of lists of sections."""
    return [
        name
        for name, (_, field, within) in _fields().items()
        if not within and section_in(field.annotation) is None
    ]


def explain(name: str) -> Key:
    """A key or a section of an experiment file.

    Parameters
    ----------
    name : str
        Dotted: ``scan.gates``, ``encounter``.

    Raises
    ------
    InputError
        No such key; the message has the nearest.

    Examples
    --------
    >>> explain("scan.thickness").default, explain("scan.gates").allowed
    ('2.5 m', 'planar, spherical')
    """
    if name in OF_A_FILE:
        return Key(name, OF_A_FILE[name], "", "", "", (), (), (), "")
    fields = _fields()
    if name not in fields:
        near = _nearest(name, fields)
        hint = f"did you mean {' or '.join(near)}?" if near else f"expected {', '.join(sections())}"
        raise InputError(f"{name}: unknown key; {hint}")
    owner, field, listed_in = fields[name]
    kinds = tuple(dict.fromkeys(sections_in(field.annotation)))
    section = kinds[0] if kinds else None
    text = tuple(part for kind in kinds for part in _paragraphs(kind))
    last = name.rpartition(".")[2]
    about = tuple(part for part in _paragraphs(owner)[1:] if re.search(rf"`{last}\b", part))
    unit = metadata_of(field, Unit)
    symbol = unit.symbol if unit else ""
    allowed = _allowed(field.annotation, field.metadata, symbol)
    return Key(
        name=name,
        meaning=field.description or (text[0].removesuffix(".") if text else ""),
        unit=symbol,
        value=field.default,
        allowed=", ".join(dict.fromkeys(allowed)),
        words=tuple(_words(field.annotation)),
        more=text if section else about,
        keys=tuple(dict.fromkeys(f"{name}.{key}" for kind in kinds for key in kind.model_fields)),
        listed_in=listed_in,
    )


def keys_of(name: str, data: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the keys of a section, of the kind that its data say; none: no section."""
    if name not in _fields():
        return ()
    annotation = _fields()[name][1].annotation
    section = tagged_section(annotation, data.get("kind")) or section_in(annotation)
    return tuple(f"{name}.{key}" for key in section.model_fields) if section else ()


@dataclass(frozen=True)
class Kind:
    """One kind of a section that ``kind`` chooses: its paragraphs and its keys."""

    word: str
    more: tuple[str, ...]
    keys: tuple[str, ...]


def kinds(name: str) -> tuple[Kind, ...]:
    """The kinds of a section; none: it has no key ``kind`` that chooses its keys."""
    annotation = _fields()[name][1].annotation
    if f"{name}.kind" not in _fields():
        return ()
    tagged = {word: tagged_section(annotation, word) for word in explain(f"{name}.kind").words}
    return tuple(
        Kind(word, _paragraphs(model), tuple(f"{name}.{key}" for key in model.model_fields))
        for word, model in tagged.items()
        if model is not None
    )


def sections() -> tuple[str, ...]:
    """Names of the keys at the top of a file."""
    return tuple(Experiment.model_fields)


@cache
def _fields() -> Mapping[str, tuple[type[BaseModel], FieldInfo, str]]:
    """Of every key: the section that has it, its field, and the list of sections that it is in."""
    fields: dict[str, tuple[type[BaseModel], FieldInfo, str]] = {}
    for name, entry in _walk(Experiment, "", ""):
        # of the kinds of a section, the first one describes the keys that they share
        fields.setdefault(name, entry)
    return fields


def _walk(
    model: type[BaseModel], above: str, listed_in: str
) -> Iterator[tuple[str, tuple[type[BaseModel], FieldInfo, str]]]:
    for key, field in model.model_fields.items():
        name = f"{above}{key}"
        yield name, (model, field, listed_in)
        for section in sections_in(field.annotation):
            yield from _walk(section, f"{name}.", listed_in or (name if _is_list(field) else ""))


def _is_list(field: FieldInfo) -> bool:
    """Whether values are lists."""
    return any(
        get_origin(kind) is tuple for kind in (field.annotation, *get_args(field.annotation))
    )


def _nearest(name: str, fields: Mapping[str, object]) -> list[str]:
    """Keys that end with these levels or begin with them, or the most similar one."""
    ends = [key for key in fields if key.endswith(f".{name}")]
    ends = ends or [key for key in fields if key.startswith(name)]
    return ends[:_MOST_SUGGESTED] or difflib.get_close_matches(name, [*fields, *OF_A_FILE], 1)


def _paragraphs(model: type[BaseModel]) -> tuple[str, ...]:
    """Paragraphs of a section's documentation, each as one line."""
    text = inspect.cleandoc(model.__doc__ or "")
    return tuple(" ".join(part.replace("``", "`").split()) for part in text.split("\n\n"))


def _as_in_a_file(value: Any, symbol: str) -> str:
    """A value as a file would have it, numbers in their usual unit."""
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, float):
        plain = not symbol or value == 0 or not math.isfinite(value)
        return f"{value:.6g}" if plain else usual(value, symbol)
    if isinstance(value, tuple | list):
        return f"[{', '.join(_as_in_a_file(member, symbol) for member in value)}]"
    return value if isinstance(value, str) else to_yaml_line(value)


def _words(annotation: Any) -> Iterator[str]:
    """Words allowed as the value of a key, except those in lists."""
    if get_origin(annotation) is Literal:
        yield from (str(word) for word in get_args(annotation))
    elif annotation is bool:
        yield from ("true", "false")
    elif isinstance(annotation, type) and issubclass(annotation, Enum):
        yield from (str(member.value) for member in annotation)
    elif get_origin(annotation) is not tuple:
        for part in get_args(annotation):
            yield from _words(part)


def _allowed(annotation: Any, metadata: Any, symbol: str) -> list[str]:
    """What is allowed, one text for each kind of value."""
    limits = [part for part in metadata if isinstance(part, Within)]
    if limits:
        return [limits[0].words(symbol)]
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return _allowed(inner, [*more, *metadata], symbol)
    if annotation is NoneType:
        return ["null"]
    if section_in(annotation) is annotation:
        return ["a section"]
    if get_origin(annotation) is Literal or not get_args(annotation):
        words = list(_words(annotation))
        if words:
            return words
    if get_origin(annotation) is tuple:
        return [_list_of(get_args(annotation), symbol)]
    if get_origin(annotation) is dict:
        return ["names: names"]
    if get_args(annotation):
        return [text for part in get_args(annotation) for text in _allowed(part, (), symbol)]
    if isinstance(annotation, type) and issubclass(annotation, tuple):
        return [f"[{', '.join(getattr(annotation, '_fields', ()))}]"]
    if annotation is int:
        least = [part.ge for part in metadata if isinstance(part, Ge)]
        return [f"a whole number from {least[0]}" if least else "a whole number"]
    if annotation is float:
        return [f"a quantity in {symbol}" if symbol else "a number"]
    return [A_NAME if any(getattr(part, "pattern", None) for part in metadata) else "text"]


def _list_of(parts: tuple[Any, ...], symbol: str) -> str:
    """A list of any length, or with one value for each of its parts."""
    each = ", ".join(_allowed(parts[0], (), symbol))
    if Ellipsis in parts:
        return f"a list of {each}" if section_in(parts[0]) is None else "a list of sections"
    return f"a list of {len(parts)}, each {each}"
