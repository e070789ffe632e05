"""Compliance of a sensor with the requirements of flight control, row by row of their tables."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from types import MappingProxyType

from lidar_mi.errors import InputError
from lidar_mi.io.yaml import read_yaml
from lidar_mi.units import to_si

PAPER = files("lidar_mi.assessment.metrics") / "requirements.yaml"
"""The paper's table 1."""

QUANTITIES: Mapping[str, tuple[str, str]] = {
    "range": ("range", "m"),
    "points_per_slab": ("points per slab", ""),
    "slabs_per_second": ("slabs per second", "Hz"),
    "slab_depth": ("slab depth", "m"),
    "error_v_los": ("error of line-of-sight velocity", "m/s"),
    "error_u": ("error of u", "m/s"),
    "error_v": ("error of v", "m/s"),
    "error_w": ("error of w", "m/s"),
}
"""Rows that a requirement table may have: name, meaning and SI unit."""

_LIMITS = {"min": "minimum", "max": "maximum", "max_of_range": "fraction_of_range"}


@dataclass(frozen=True)
class Requirement:
    """One row of a table, SI: from ``minimum`` to ``maximum`` and a ``fraction_of_range``."""

    quantity: str
    minimum: float = 0.0
    maximum: float = math.inf
    fraction_of_range: float = math.inf


@dataclass(frozen=True)
class RequirementTable:
    """Requirements of one application in one phase of flight.

    ``slowest`` and ``fastest`` are the air speeds, m/s, between which the phase is flown.
    """

    application: str
    title: str
    phase: str
    rows: tuple[Requirement, ...]
    slowest: float = 0.0
    fastest: float = math.inf

    def applies_at(self, speed: float) -> bool:
        """Whether an aircraft of this air speed, m/s, is in the phase of flight."""
        return self.slowest <= speed <= self.fastest


@dataclass(frozen=True)
class Finding:
    """One row, judged.

    quantity: a key of `QUANTITIES`.
    minimum, maximum: required limits at the measured range; NaN if they depend on a range and there
        is none.
    measured: NaN: not known.
    passed: none: not judged.
    margin: distance from the nearer limit as a fraction of it: 0.2 is 20 % better than required,
        -0.2 20 % worse; NaN where not judged.
    reason: why it is not judged; empty where it is.
    """

    quantity: str
    minimum: float
    maximum: float
    measured: float
    passed: bool | None
    margin: float
    reason: str = ""


def read_requirements(
    path: str | Path | Traversable = PAPER,
) -> dict[tuple[str, str], RequirementTable]:
    """Requirement tables by (application, phase of flight), from a YAML file like the shipped one.

    Raises InputError: a file that cannot be read, a row or a limit that is not known, a value with
    a wrong unit.
    """
    data = read_yaml(str(path), "a requirement table")
    tables = {}
    for application, phases in _section(data, str(path)).items():
        place = f"{path}: {application}"
        phases = dict(_section(phases, place))
        title = phases.pop("title", application)
        for phase, rows in phases.items():
            inside = f"{place}.{phase}"
            tables[application, phase] = _table(inside, application, str(title), phase, rows)
    return tables


def judge(
    table: RequirementTable,
    measured: Mapping[str, float | None],
    not_judged: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """A sensor against a table, row by row.

    measured: the sensor's values, SI, by names of `QUANTITIES`; None, NaN or absent: not known.
        Names without a row in the table are ignored.
    not_judged: reasons why rows are not judged, by names of `QUANTITIES`, whatever was measured.
    """
    for name, value in measured.items():
        _check_name(name, "measured")
        if value is not None and (value < 0 or math.isinf(value)):
            unit = QUANTITIES[name][1]
            raise InputError(
                f"measured.{name}: {value} {unit} is not allowed; expected >= 0 {unit}"
            )
    values = {name: math.nan if value is None else float(value) for name, value in measured.items()}
    distance = values.get("range", math.nan)
    return [
        _judged(row, values.get(row.quantity, math.nan), distance, not_judged.get(row.quantity, ""))
        for row in table.rows
    ]


def fulfilled(findings: Sequence[Finding]) -> bool | None:
    """Whether all rows pass; None if none fails but some are not judged."""
    results = {finding.passed for finding in findings}
    # a row that fails decides, whatever is unknown of others
    if False in results:
        return False
    return None if None in results else True


def look_ahead(distance: float, speed: float) -> float:
    """Time until the aircraft reaches the measured air, s: range over air speed; inf at rest."""
    for name, value, unit in (("range", distance, "m"), ("speed", speed, "m/s")):
        if not value >= 0:
            raise InputError(f"{name}: {value} {unit} is not allowed; expected >= 0 {unit}")
    return distance / speed if speed else math.inf


def as_rows(findings: Sequence[Finding]) -> list[tuple[str, str, str, str, str]]:
    """Findings as text: property, required, measured, margin, verdict."""
    rows = []
    for finding in findings:
        name, unit = QUANTITIES[finding.quantity]
        reason = f": {finding.reason}" if finding.reason else ""
        verdict = {True: "pass", False: "fail", None: f"not judged{reason}"}[finding.passed]
        margin = "" if math.isnan(finding.margin) else f"{100 * finding.margin:+.0f} %"
        # none has no sign
        margin = "0 %" if margin in ("+0 %", "-0 %") else margin
        measured = _with_unit(finding.measured, unit) if not math.isnan(finding.measured) else ""
        rows.append((name, _required(finding, unit), measured, margin, verdict))
    return rows


Judged = Sequence[tuple[RequirementTable, Sequence[Finding]]]
"""Requirement tables with the findings for each."""


def _section(data: object, place: str) -> Mapping[str, object]:
    if not isinstance(data, dict) or not data:
        raise InputError(f"{place}: {data!r} is not allowed; expected a section with keys")
    return data


def _check_name(name: str, place: str) -> None:
    if name in QUANTITIES:
        return
    close = difflib.get_close_matches(str(name), QUANTITIES, 1)
    hint = f"; did you mean {close[0]}?" if close else ""
    raise InputError(f"{place}.{name}: unknown row{hint} (allowed: {', '.join(QUANTITIES)})")


def _table(place: str, application: str, title: str, phase: str, rows: object) -> RequirementTable:
    rows = dict(_section(rows, place))
    speed = _limits(f"{place}.speed", rows.pop("speed")) if "speed" in rows else {}
    if "fraction_of_range" in speed:
        raise InputError(f"{place}.speed.max_of_range: not allowed; expected min or max")
    requirements = tuple(_row(place, *row) for row in _section(rows, place).items())
    slowest, fastest = speed.get("minimum", 0.0), speed.get("maximum", math.inf)
    return RequirementTable(application, title, phase, requirements, slowest, fastest)


def _row(place: str, quantity: str, limits: object) -> Requirement:
    _check_name(quantity, place)
    unit = QUANTITIES[quantity][1]
    place = f"{place}.{quantity}"
    row = Requirement(quantity, **_limits(place, limits, unit))
    if unit != "m" and math.isfinite(row.fraction_of_range):
        raise InputError(f"{place}.max_of_range: not allowed; only lengths compare with a range")
    return row


def _limits(place: str, limits: object, unit: str = "m/s") -> dict[str, float]:
    """Limits in SI by the names that they have in `Requirement`."""
    si: dict[str, float] = {}
    for limit, value in _section(limits, place).items():
        if limit not in _LIMITS:
            raise InputError(f"{place}.{limit}: unknown limit (allowed: {', '.join(_LIMITS)})")
        try:
            number = to_si(value, "" if limit == "max_of_range" else unit, f"10 {unit}".strip())
        except ValueError as error:
            raise InputError(f"{place}.{limit}: {error}") from None
        if not (number > 0 and math.isfinite(number)):
            raise InputError(f"{place}.{limit}: {value!r} is not allowed; expected more than 0")
        si[_LIMITS[limit]] = number
    if si.get("minimum", 0.0) > si.get("maximum", math.inf):
        raise InputError(f"{place}: min above max is not allowed")
    return si


def _judged(row: Requirement, measured: float, distance: float, reason: str) -> Finding:
    of_range = (
        row.fraction_of_range * distance if math.isfinite(row.fraction_of_range) else math.inf
    )
    # min() would lose a NaN
    maximum = of_range if math.isnan(of_range) else min(row.maximum, of_range)
    margins = []
    if row.minimum > 0:
        margins.append(measured / row.minimum - 1)
    if not math.isinf(maximum):
        margins.append(1 - measured / maximum)
    if not reason and (math.isnan(measured) or math.isnan(maximum)):
        reason = "not measured" if math.isnan(measured) else "the range is not known"
    # the nearer limit decides
    margin = math.nan if reason else min(margins, default=math.inf)
    passed = None if reason else row.minimum <= measured <= maximum
    return Finding(row.quantity, row.minimum, maximum, measured, passed, margin, reason)


def _required(finding: Finding, unit: str) -> str:
    if math.isnan(finding.maximum):
        return "fraction of the range"
    low, high = _with_unit(finding.minimum, unit), _with_unit(finding.maximum, unit)
    if math.isinf(finding.maximum):
        return f"at least {low}"
    return f"{finding.minimum:.4g} to {high}" if finding.minimum > 0 else f"at most {high}"


def _with_unit(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".strip() if value < 1000 else f"{value:.0f} {unit}".strip()
