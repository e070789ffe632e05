"""What the sections of an experiment file have in common."""

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict

from lidar_mi.description import Description


class Section(Description):
    """A part of an experiment file: frozen, every key known, no NaN or infinity."""

    # enumerations hold what is allowed; values are plain strings, as files and data sets hold them
    model_config = ConfigDict(use_enum_values=True)


def section_in(annotation: Any) -> type[BaseModel] | None:
    """The section in an annotation such as ``tuple[Section, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(section_in, get_args(annotation))), None)


def each_once(key: str, values: tuple[object, ...]) -> None:
    """Refuse values of which one occurs twice."""
    twice = next((value for value in values if values.count(value) > 1), None)
    if twice is not None:
        raise ValueError(f"{key}: {twice!r} twice is not allowed; expected each once")
