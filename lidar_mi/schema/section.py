"""Common properties of the sections of an experiment file."""

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, Tag
from pydantic.fields import FieldInfo

from lidar_mi.description import Description


class Section(Description):
    """A part of an experiment file: frozen, every key known, no NaN or infinity."""

    # enumerations hold what is allowed; values are plain strings, as files and data sets hold them
    model_config = ConfigDict(use_enum_values=True)


def sections_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The sections in an annotation such as ``tuple[Section, ...] | None``, one of each kind."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from sections_in(part)


def section_in(annotation: Any) -> type[BaseModel] | None:
    """The first section in an annotation; None: there is none."""
    return next(sections_in(annotation), None)


def tagged_section(annotation: Any, tag: object) -> type[BaseModel] | None:
    """The section of a kind, by its tag in a discriminated union; None: there is none."""
    if any(isinstance(part, Tag) and part.tag == tag for part in get_args(annotation)):
        return section_in(annotation)
    sections = (tagged_section(part, tag) for part in get_args(annotation))
    return next(filter(None, sections), None)


def metadata_of(field: FieldInfo | None, kind: type) -> Any:
    """Metadata of a type in the annotation of a key, the outermost; None without any."""
    pending = [field.annotation, *field.metadata] if field else []
    while pending:
        part = pending.pop()
        if isinstance(part, kind):
            return part
        pending += (*get_args(part), *getattr(part, "__metadata__", ()))
    return None


def each_once(key: str, values: tuple[object, ...]) -> None:
    """Refuse values of which one occurs twice."""
    twice = next((value for value in values if values.count(value) > 1), None)
    if twice is not None:
        raise ValueError(f"{key}: {twice!r} twice is not allowed; expected each once")
