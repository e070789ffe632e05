"""Hypothesis strategies for experiment files, from the schema: a new key is covered at once."""

import enum
import math
from collections.abc import Iterator
from importlib.resources import files
from typing import Any, Literal, get_args, get_origin

import yaml
from hypothesis import strategies as st
from pydantic import BaseModel

from lidar_mi.schema.experiment import Experiment
from lidar_mi.units import Unit, Within
from tests.support.cases import Case
from tests.support.hostile_values import ANYTHING, NUMBERS, damaged

PAIR = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
BASE = {
    "name": "a",
    "wake": {"vortex_pair": PAIR},
    "render": {"samples_per_beam": 4, "max_order": 1},
    "retrieval": {"methods": ["cc"]},
}
RINGS = {
    "name": "b",
    "doppler": {
        "camera": {"pixel": "59.2 um", "width": 120, "height": 98},
        "v_los": ["70 m/s"],
        "ccd": {"full_well": 1e6},
        "retrieval": {"methods": ["annular"], "averaged": [1], "images": 1, "slow_images": 0},
        "path_samples": 0,
        "render": {"samples_per_pixel": 4},
    },
}
BOTH = {
    **BASE,
    **RINGS,
    "name": "c",
    "sensor": {"method": "cc", "crossflow_std": "0.8 m/s"},
    "scan": {"range": "75 m"},
}
VOLUME = {
    "name": "d",
    "wake": {"turbine": {"width": 30, "height": 20}, "spacing": "1 m"},
    "scan": {"range": "100 m", "thickness": "10 m", "gate_count": 10},
    "render": {"samples_per_beam": 10, "max_order": 1},
    "volume": {"methods": ["correlation"], "stride": 4},
}
BASES = (BASE, RINGS, BOTH, VOLUME)


def keys(model: type[BaseModel] = Experiment, above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys of the schema, sections too, and what each is annotated with."""
    for name, info in model.model_fields.items():
        annotation = (info.annotation, *info.metadata)
        yield above + name, annotation
        inner = next((part for part in parts(annotation) if is_section(part)), None)
        if inner is not None:
            yield from keys(inner, f"{above}{name}.")


def parts(annotation: Any) -> Iterator[Any]:
    """An annotation, what it is made of, and the metadata in it."""
    yield annotation
    inner = annotation if isinstance(annotation, tuple) else get_args(annotation)
    for part in (*inner, *getattr(annotation, "__metadata__", ())):
        if get_origin(annotation) is not Literal:
            yield from parts(part)


def is_section(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, BaseModel)


KEYS = dict(keys())


def values(annotation: Any) -> st.SearchStrategy:
    """What is allowed and what is beside it, for a key with an annotation."""
    found = list(parts(annotation))
    unit = next((part.symbol for part in found if isinstance(part, Unit)), "")
    choices = [ANYTHING]
    for part in found:
        if isinstance(part, Within):
            ends = [part.low, part.high, (part.low + part.high) / 2]
            if part.low > 0:
                ends.append(math.sqrt(part.low * part.high))
            beside = [math.nextafter(end, way) for end in ends[:2] for way in (-math.inf, math.inf)]
            inside = st.floats(part.low, part.high)
            numbers = st.sampled_from(ends + beside) | inside
            choices += [numbers.map(lambda number: f"{number!r} {unit}".strip())] * 3
        elif get_origin(part) is Literal:
            choices.append(st.sampled_from(get_args(part)))
        elif isinstance(part, type) and issubclass(part, enum.Enum):
            choices.append(st.sampled_from([one.value for one in part]))
            choices.append(st.lists(st.sampled_from([one.value for one in part]), max_size=3))
        elif part is int:
            choices.append(st.integers(0, 40))
        elif part is bool:
            choices.append(st.booleans())
        elif part is float:
            choices.append(NUMBERS)
            choices.append(st.lists(NUMBERS.map(lambda n: f"{n!r} {unit}".strip()), max_size=3))
        elif is_section(part):
            choices.append(st.just({}))
    return st.one_of(choices)


@st.composite
def settings(draw: st.DrawFn) -> dict:
    """A small experiment of one of the kinds, some keys of which are changed."""
    data = yaml.safe_load(yaml.safe_dump(draw(st.sampled_from(BASES))))
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from(sorted(KEYS)))
        change(data, key, draw(values(KEYS[key])))
    return data


def change(data: dict, key: str, value: object) -> None:
    *sections, last = key.split(".")
    for section in sections:
        if not isinstance(data.get(section), dict):
            data[section] = {}
        data = data[section]
    data[last] = value


@st.composite
def experiments(draw: st.DrawFn) -> Case:
    """A file of wrong, unusual and missing values, to be checked."""
    data = draw(settings())
    if draw(st.booleans()):
        data.pop(draw(st.sampled_from(sorted(data))))
    return Case("experiment", ("check", "a.yaml"), {"a.yaml": as_yaml(data)})


@st.composite
def overrides(draw: st.DrawFn) -> Case:
    """Keys changed on the command line."""
    call = ["check", "a.yaml"]
    for _ in range(draw(st.integers(1, 2))):
        key = draw(st.sampled_from(sorted(KEYS)))
        value = as_yaml(draw(values(KEYS[key]))).decode().removesuffix("...\n").strip()
        call += ["--set", f"{key}={value}".replace("\0", "")]
    return Case("override", tuple(call), {"a.yaml": as_yaml(BASE)})


@st.composite
def structures(draw: st.DrawFn) -> Case:
    """YAML that is damaged, or of another structure than any experiment's."""
    bases = [*BASES, {**BASE, "variants": {"v": {}}}]
    text = as_yaml(draw(st.sampled_from(bases)))
    insert = draw(st.sampled_from(STRUCTURES)).encode()
    if draw(st.booleans()):
        lines = text.splitlines(keepends=True)
        place = draw(st.integers(0, len(lines)))
        text = b"".join([*lines[:place], insert + b"\n", *lines[place:]])
    if draw(st.booleans()):
        text = draw(damaged(text))
    return Case("yaml", ("check", "a.yaml"), {"a.yaml": text})


STRUCTURES = (
    "seed: !!int abc",
    "seed: 2020-13-45",
    "seed: 2020-01-01",
    "seed: &a [*a]",
    "seed: !!binary aGk=",
    "seed: " + "9" * 5000,
    "? [a]\n: b",
    "seed: !!set {a, b}",
    "<<: {seed: 3}",
    "variants: {a: {seed: 2}, report.html: {}}",
    "variants: {1: {}, 1.0: {}, true: {}}",
    "variants: {a: {name: b}}",
    "variants: []",
    "- " * 2000,
    "seed: 1:2:3",
    "--- a",
    "%YAML 9.9",
    "wake: null",
)


def scenes() -> dict[str, bytes]:
    """Shipped files by name."""
    folder = files("lidar_mi.scenes")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def as_yaml(data: object) -> bytes:
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=False).encode()
