"""The points of a campaign: from a number to an experiment, without a list of all."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from lidar_mi.campaign.description import Campaign, Range
from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import value_at
from lidar_mi.schema import reading
from lidar_mi.schema.experiment import Experiment
from lidar_mi.units import registry, split_quantity

MEMBER, SAMPLE = "member", "sample"
"""Names of dimensions that are no keys."""


@dataclass(frozen=True)
class Dimension:
    """One dimension of a campaign's points.

    name: a dotted key, a name of its own, or `SAMPLE`.
    labels: values as an experiment file has them, or names.
    changes: keys that each label changes, dotted.
    named: whether it has sets of changes by name; else its changes are those of keys.
    scale: either linear or log, of a range; empty where the description does not say.
    """

    name: str
    labels: tuple[Any, ...]
    changes: tuple[dict[str, Any], ...]
    named: bool
    scale: str = ""


class Points:
    """All points of a campaign, in the order of the file, members last and fastest.

    base: keys of the base experiment.
    search_path: folder in which files named by the experiments are searched first.

    Raises InputError: two dimensions that change one key.
    """

    def __init__(self, campaign: Campaign, base: dict[str, Any], search_path: str | Path) -> None:
        self.campaign, self.search_path = campaign, Path(search_path)
        self.dimensions = tuple(_dimensions(campaign))
        # the name of a point does not change its results
        self.base = reading.merged(base, _nested(campaign.set))
        self.seed = campaign.seed if campaign.seed is not None else self.base.get("seed", 1)
        _refuse_overlaps(self.dimensions)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of values in each dimension; the last one is that of members."""
        return (*(len(dimension.labels) for dimension in self.dimensions), self.campaign.members)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def index(self, number: int) -> tuple[int, ...]:
        """Indices of a point in all dimensions."""
        return tuple(int(k) for k in np.unravel_index(number, self.shape))

    def title(self, number: int) -> str:
        """A point by its values: "scan.range 150 m, case day, member 3"."""
        *index, member = self.index(number)
        words = [
            f"{dimension.name} {dimension.labels[k]}"
            for dimension, k in zip(self.dimensions, index, strict=True)
        ]
        return ", ".join(words + ([f"member {member}"] if self.campaign.members > 1 else []))

    def experiment(self, number: int) -> Experiment:
        """The experiment of a point.

        Raises InputError: an unknown key, a wrong unit, a value out of range.
        """
        *index, member = self.index(number)
        data = self.base
        for dimension, k in zip(self.dimensions, index, strict=True):
            data = reading.merged(data, _nested(dimension.changes[k]))
        independent = self.campaign.sample and self.campaign.sample.random == "independent"
        data = data | {"seed": member_seed(self.seed, member, *(index if independent else ()))}
        experiment = reading.check(data, self.title(number))
        return experiment.read_from(self.search_path)

    def coordinates(self) -> dict[str, tuple[str, list[Any]]]:
        """Values of every key and name by the dimension along which they vary.

        Returns
        -------
        dict
            By name: the dimension, and numbers in SI units, text or numbers from 0 on. Units are
            those of `units`.
        """
        coordinates: dict[str, tuple[str, list[Any]]] = {}
        for axis, dimension in enumerate(self.dimensions):
            if dimension.name == SAMPLE:
                coordinates[SAMPLE] = (SAMPLE, list(dimension.labels))
                for keys in self.campaign.sample.over if self.campaign.sample else ():
                    key = tied(keys)[0]
                    coordinates[key] = (SAMPLE, self._values(axis, key))
            else:
                if dimension.named:
                    values, _ = _quantities(dimension.labels)
                else:
                    values = self._values(axis, dimension.name)
                coordinates[dimension.name] = (dimension.name, values)
        return coordinates

    def units(self) -> dict[str, str]:
        """SI units of the keys that vary, as far as they have one."""
        units: dict[str, str] = {}
        for dimension in self.dimensions:
            if dimension.named:
                _, unit = _quantities(dimension.labels)
                units |= {dimension.name: unit} if unit else {}
                continue
            for key in dimension.changes[0]:
                value = value_at(reading.settings(self.experiment(0), si=True), key)
                if isinstance(value, str) and _number(value) is not None:
                    units[key] = value.partition(" ")[2]
        return units

    def _values(self, axis: int, key: str) -> list[Any]:
        """Values of a key along a dimension, as the experiments have them."""
        # the first points along this dimension; of others the same values follow
        stride = math.prod(self.shape[axis + 1 :])
        values = [
            value_at(reading.settings(self.experiment(k * stride), si=True), key)
            for k in range(self.shape[axis])
        ]
        numbers = [_number(value) for value in values]
        if all(number is not None for number in numbers):
            return numbers
        return [str(value) for value in self.dimensions[axis].labels]


def member_seed(seed: int, *numbers: int) -> int:
    """Seed of a member: the same at every point, so that differences between points have no noise.

    Points with random numbers of their own add theirs to the member's number.
    """
    state = np.random.SeedSequence((seed, *numbers)).generate_state(1)
    return int(state[0]) % 2**31


def _dimensions(campaign: Campaign) -> Iterator[Dimension]:
    for key, values in campaign.sweep.items():
        if isinstance(values, dict):
            yield Dimension(key, tuple(values), tuple(map(_flat, values.values())), True)
        else:
            labels = tuple(values.values() if isinstance(values, Range) else values)
            keys = tied(key)
            changes = tuple(dict.fromkeys(keys, value) for value in labels)
            scale = values.scale if isinstance(values, Range) else ""
            yield Dimension(keys[0], labels, changes, False, scale)
    if campaign.sample:
        yield _sampled(campaign)


def _sampled(campaign: Campaign) -> Dimension:
    """The points of a space-filling sample, scrambled by the campaign's seed."""
    sample = campaign.sample
    assert sample is not None  # checked by `_dimensions`
    kinds = {"sobol": qmc.Sobol, "latin_hypercube": qmc.LatinHypercube}
    # the same points at every start of the campaign
    random = np.random.default_rng(campaign.seed or 0)
    unit = kinds[sample.method](len(sample.over), rng=random).random(sample.n)
    columns = [
        span.quantities(column.tolist())
        for span, column in zip(sample.over.values(), unit.T, strict=True)
    ]
    changes = [
        {key: value for keys, value in zip(sample.over, row, strict=True) for key in tied(keys)}
        for row in zip(*columns, strict=True)
    ]
    return Dimension(SAMPLE, tuple(range(sample.n)), tuple(changes), False)


def tied(keys: str) -> list[str]:
    """Keys that share their values, as the description joins them: "scan.range, doppler.range"."""
    return [key.strip() for key in keys.split(",")]


def _quantities(labels: Sequence[str]) -> tuple[list[Any], str]:
    """Names of sets of changes; those that are all quantities of one kind as numbers in SI."""
    try:
        quantities = [
            registry().Quantity(*split_quantity(_plain(label))).to_base_units() for label in labels
        ]
    except Exception:  # words; pint raises whatever its parser does
        return list(labels), ""
    if len({number.units for number in quantities}) > 1:
        return list(labels), ""
    return [float(number.magnitude) for number in quantities], f"{quantities[0].units:~C}"


def _plain(label: str) -> str | float:
    """A label as a number, if it is one."""
    try:
        return float(label)
    except ValueError:
        return label


def _refuse_overlaps(dimensions: Sequence[Dimension]) -> None:
    owner: dict[str, str] = {}
    for dimension in dimensions:
        for key in dict.fromkeys(key for changes in dimension.changes for key in changes):
            clash = next((k for k in owner if _overlap(k, key)), None)
            if clash:
                raise InputError(
                    f"sweep.{dimension.name}: {key} is not allowed; expected no key that "
                    f"{owner[clash]} changes, too"
                )
        owner |= {key: dimension.name for changes in dimension.changes for key in changes}


def _overlap(first: str, second: str) -> bool:
    # a section overlaps its keys: the dots keep scan apart from scanner
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")


def _flat(changes: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested sections as dotted keys; an empty section is a value."""
    dotted: dict[str, Any] = {}
    for key, value in changes.items():
        name = f"{above}{key}"
        nested = isinstance(value, Mapping) and value
        dotted |= _flat(value, f"{name}.") if nested else {name: value}
    return dotted


def _nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys as nested sections."""
    sections: dict[str, Any] = {}
    for key, value in changes.items():
        for part in reversed(key.split(".")):
            value = {part: value}
        sections = reading.merged(sections, value) if sections else dict(value)
    return sections


def _number(value: object) -> float | None:
    """A number, with or without its SI unit; None: it is none."""
    if isinstance(value, bool) or value is None:
        return None
    try:
        return float(str(value).partition(" ")[0])
    except ValueError:
        return None
