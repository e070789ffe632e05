"""The description of a campaign in YAML: which experiments, over which values, how often."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.io.yaml import parse_yaml, read_yaml
from lidar_mi.schema.experiment import NAME
from lidar_mi.schema.faults import first_fault
from lidar_mi.units import Within, split_quantity

KEYS = ("base", "sweep", "sample", "members")
"""Keys that only a campaign has."""

LARGEST = 10**7
"""Most values of a dimension, points of a sample, members: more are a typing error."""


class Span(Description):
    """An interval of values, between two ends of the same unit.

    Attributes
    ----------
    linear, log : tuple of (number or text), optional
        Both ends, on a linear or a logarithmic scale: exactly one of the two.
    """

    linear: tuple[Any, Any] | None = None
    log: tuple[Any, Any] | None = None

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if (self.linear is None) == (self.log is None):
            raise ValueError("expected linear: [FIRST, LAST] or log: [FIRST, LAST]")
        first, last = self.ends()
        if first == last:
            raise ValueError(f"{self._ends()} is not allowed; expected two different ends")
        if self.log and not (first > 0 and last > 0):
            raise ValueError(f"{self._ends()} is not allowed; expected ends above 0 for log")
        return self

    @property
    def scale(self) -> str:
        """Scale: linear or log."""
        return "linear" if self.linear else "log"

    @property
    def unit(self) -> str:
        """The unit of both ends, as written."""
        return split_quantity(self._ends()[0])[1]

    def ends(self) -> tuple[float, float]:
        """Both ends in `unit`.

        Raises ValueError: no quantities, or of two units.
        """
        (first, unit), (last, other) = map(split_quantity, self._ends())
        if unit != other:
            raise ValueError(
                f"{self._ends()} is not allowed; expected one unit, not {unit or 'none'} and "
                f"{other or 'none'}"
            )
        return first, last

    def at(self, fractions: list[float]) -> list[float]:
        """Values at fractions of the interval, in `unit`; ends without rounding."""
        first, last = self.ends()
        values = []
        for fraction in fractions:
            if fraction in (0, 1):
                values.append(last if fraction else first)
            elif self.linear:
                values.append(first + fraction * (last - first))
            else:
                values.append(first * (last / first) ** fraction)
        return values

    def quantities(self, fractions: list[float]) -> list[Any]:
        """Values at fractions of the interval, as an experiment file has them."""
        return [f"{v!r} {self.unit}" if self.unit else v for v in self.at(fractions)]

    def _ends(self) -> tuple[Any, Any]:
        """Both ends as they are written."""
        ends = self.linear or self.log
        assert ends is not None  # `_one_scale`
        return ends


class Range(Span):
    """Evenly spaced values of a dimension, on a linear or a logarithmic scale, ends included."""

    n: Annotated[int, Within(2, LARGEST, "a point for each")]

    def values(self) -> list[Any]:
        """The values as an experiment file has them."""
        return self.quantities([k / (self.n - 1) for k in range(self.n)])


class Sample(Description):
    """A space-filling sample of several keys (`scipy.stats.qmc`).

    Attributes
    ----------
    method : str
        Either sobol or latin_hypercube.
    n : int
        Number of points.
    over : dict of str to Span
        Keys and the intervals of their values.
    random : str
        Random numbers of the points: common, so that differences between points are those of the
        keys, or independent, so that the points are a sample of what may happen.
    """

    method: Literal["sobol", "latin_hypercube"] = "sobol"
    n: Annotated[int, Within(2, LARGEST, "a point for each")]
    over: dict[str, Span] = Field(min_length=1)
    random: Literal["common", "independent"] = "common"

    @model_validator(mode="after")
    def _balanced(self) -> Self:
        # Sobol points fill space evenly in numbers of 2^m alone
        if self.method == "sobol" and self.n & (self.n - 1):
            below = 1 << (self.n.bit_length() - 1)
            raise ValueError(
                f"n: {self.n} is not allowed with method sobol; expected a power of 2 such as "
                f"{below} or {2 * below}, or method latin_hypercube"
            )
        return self


class Campaign(Description):
    """Many experiments that differ from a base in some keys.

    Attributes
    ----------
    name : str
    base : str
        An experiment: a file, or the name of a shipped one.
    seed : int
        Members' random numbers follow from it; None: from the seed of the base.
    set : dict
        Keys that differ from the base in all points.
    sweep : dict
        Dimensions, each with a list of values, a `Range`, or named sets of changed keys.
    sample : Sample, optional
        In place of ``sweep``.
    members : int
        Repeats with random numbers of their own.
    keep : str
        What stays of every point: its metrics, its estimates too (winds, vortices), or a whole run
        folder.
    quick : dict
        Keys of this description that differ in a coarse version.
    """

    name: str = Field(pattern=f"^{NAME}$")
    base: str
    seed: Annotated[int, Within(0, 2**31 - 1, "integers of an image header")] | None = None
    set: dict[str, Any] = Field(default_factory=dict)
    sweep: dict[str, Range | list[Any] | dict[str, dict[str, Any]]] = Field(default_factory=dict)
    sample: Sample | None = None
    members: Annotated[int, Within(1, LARGEST, "a point for each")] = 1
    keep: Literal["metrics", "estimates", "everything"] = "metrics"
    quick: dict[str, Any] = Field(default_factory=dict)

    @field_validator("sweep", mode="before")
    @classmethod
    def _dimensions(cls, value: Any) -> Any:
        """Dimensions parsed by kind, so that a fault is reported for the right kind."""
        if not isinstance(value, dict):
            raise ValueError(f"sweep: {value!r} is not allowed; expected keys with their values")
        return {str(key): _dimension(str(key), values) for key, values in value.items()}

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.sweep and self.sample:
            raise ValueError("sweep and sample: not allowed together; expected one of the two")
        if not self.sweep and not self.sample and self.members == 1:
            raise ValueError("sweep: missing; expected sweep, sample or several members")
        reserved = {"seed": "members", "member": "members", "sample": "sample", "name": "name"}
        for key in (*self.sweep, *(self.sample.over if self.sample else ())):
            if key in reserved:
                raise ValueError(f"sweep.{key}: not allowed; expected {reserved[key]} for this")
        return self


def _dimension(key: str, values: Any) -> Range | list[Any] | dict[str, dict[str, Any]]:
    """One dimension of a sweep; a fault is a ValueError."""
    place = f"sweep.{key}"
    if isinstance(values, dict) and {"linear", "log", "n"} & set(values):
        try:
            return Range.model_validate(values)
        except ValidationError as error:
            raise ValueError(f"{place}: {first_fault(error, Range)}") from None
    if isinstance(values, dict):
        for name, changes in values.items():
            if not isinstance(changes, dict):
                raise ValueError(
                    f"{place}.{name}: {changes!r} is not allowed; expected keys to change"
                )
        values = {str(name): changes for name, changes in values.items()}
    if not isinstance(values, dict | list) or not values:
        raise ValueError(
            f"{place}: {values!r} is not allowed; expected a list of values, linear or log: "
            "[FIRST, LAST] with n, or names with keys to change"
        )
    if isinstance(values, list):
        _check_list(place, values)
    return values


def _check_list(place: str, values: list[Any]) -> None:
    """Refuse equal values, and values of different units."""
    # a list: values may be lists themselves, which no set holds
    unique: list[Any] = []
    for value in values:
        if value in unique:
            raise ValueError(f"{place}: {value!r} twice is not allowed; expected each once")
        unique.append(value)
    units = []
    for value in values:
        try:
            number, unit = split_quantity(value)
        except ValueError:  # words
            continue
        if math.isfinite(number):
            units.append(unit)
    another = next((unit for unit in units if unit != units[0]), None)
    if another is not None:
        raise ValueError(
            f"{place}: values in {units[0] or 'no unit'} and in {another or 'no unit'} are not "
            "allowed; expected one unit"
        )


def read_campaign(
    path: str | Path, overrides: list[str] | None = None, *, quick: bool = False
) -> Campaign:
    """Read a campaign file.

    path: a campaign file, or an experiment with ``variants``, which are its one dimension.
    overrides: texts such as ``"members=4"`` or ``"set.scan.range=200 m"``.
    quick: the coarse version that the file describes.

    Raises InputError: unreadable file, unknown key, a dimension that is none: the first fault is
    named.
    """
    data = read_yaml(path, "a campaign file")
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no keys; expected name, base, sweep, ...")
    if "variants" in data and not set(KEYS) & set(data):
        data = {"name": data.get("name"), "base": str(path), "sweep": {"variant": data["variants"]}}
    if not set(KEYS) & set(data) and {"wake", "doppler"} & set(data):
        raise InputError(
            f"{path}: one experiment, not a campaign; expected lidar-mi run, or a file with base "
            "and sweep"
        )
    for override in overrides or []:
        key, equals, value = override.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {override}: expected KEY=VALUE, such as members=4")
        section, _, inner_key = key.strip().partition(".")
        parsed = parse_yaml(value, key)
        if inner_key:
            inner = data.setdefault(section, {})
            if not isinstance(inner, dict):
                raise InputError(f"--set {override}: {section} is a value, not a section")
            inner[inner_key] = parsed
        else:
            data[section] = parsed
    if quick:
        coarse = data.get("quick")
        if not isinstance(coarse, dict) or not coarse:
            raise InputError(f"{path}: quick: missing; expected the keys of a coarse version")
        data = _coarser(data, coarse)
        data["name"] = f"{data.get('name')}.quick"
    return checked_campaign(data, str(path))


def _coarser(data: dict[str, Any], coarse: dict[str, Any]) -> dict[str, Any]:
    """A description with other values of some keys; a list of names selects named sets."""
    changed, scales = dict(data), {"linear", "log"}
    for key, value in coarse.items():
        before = data.get(key)
        if isinstance(value, dict) and isinstance(before, dict) and not scales & set(value):
            changed[key] = _coarser(before, value)
        elif isinstance(value, list) and isinstance(before, dict) and set(value) <= set(before):
            changed[key] = {name: before[name] for name in value}
        else:
            changed[key] = value
    return changed


def checked_campaign(data: Mapping[str, Any], origin: str) -> Campaign:
    """A campaign from a nested dictionary; errors as of `read_campaign`."""
    try:
        return Campaign.model_validate(data)
    except ValidationError as error:
        # faults of a dimension name it already
        fault = first_fault(error, Campaign).replace("sweep: sweep.", "sweep.", 1)
        raise InputError(f"{origin}: {fault}") from None
