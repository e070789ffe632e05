"""Tables of numbers in time or by altitude, from CSV or NetCDF: trajectories, soundings."""

import csv
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.netcdf import load_variable, open_netcdf
from lidar_mi.io.text import read_text
from lidar_mi.io.time_axis import count_unit
from lidar_mi.units import conversion

TIME = "t"
"""Name of the time, s."""

_ALLOWED = {"rad": "deg or rad", "Pa": "Pa or hPa", "K": "K (that of 0 degrees Celsius: 273.15)"}
"""Units of a column by its SI unit."""

_HEAD = re.compile(r"\s*(\w+)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*")


def read_timed_table(
    path: str | Path, units: Mapping[str, str], axis: str = TIME
) -> dict[str, np.ndarray]:
    """Columns of a table by their names, in SI units, and the time ``t`` or another axis.

    A CSV file has a head with names and units, "t (s), roll (deg)", and lines that begin with #
    are comments; a NetCDF file has variables of one dimension with the attribute ``units``. Without
    a unit, times and lengths are SI; angles and pressures must have one.

    path: NetCDF by its suffix (.nc, .nc4, .cdf), else CSV.
    units: names of columns and their SI units. Those of the file that are not asked for are
        ignored.
    axis: the column that increases: the time, or one of ``units``.

    Raises InputError: a file that cannot be read, no axis, none of the columns, fewer than two
    rows, a unit that does not convert, a value that is no finite number, an axis that does not
    increase.

    Returns
    -------
    dict of str to (n,) array
        The axis and what of the columns there is.
    """
    path = Path(path)
    expected = {TIME: "s", **units} if axis == TIME else dict(units)
    read = _netcdf if path.suffix in (".nc", ".nc4", ".cdf") else _csv
    columns, heads = read(path, expected)
    if axis not in columns or len(columns) == 1:
        missing = axis if axis not in columns else f"all of {', '.join(units)}"
        there = ", ".join(repr(head.strip()[:40]) for head in heads[:8])
        raise InputError(
            f"{path}: {missing} missing; expected columns {', '.join(expected)}, not {there}"
        )
    table = {}
    for name, (values, unit) in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise InputError(
                f"{path}: {name}: {values[bad[0]]} in row {bad[0] + 1} is not allowed; expected "
                "finite numbers"
            )
        table[name] = values * _factor(unit, expected[name], name, path)
    along, unit = table[axis], expected[axis]
    if len(along) < 2:
        raise InputError(f"{path}: {len(along)} rows; expected two or more")
    back = np.flatnonzero(~(np.diff(along) > 0))
    if back.size:
        row = int(back[0]) + 1
        raise InputError(
            f"{path}: {axis}: {along[row]:.15g} {unit} in row {row + 1} after "
            f"{along[row - 1]:.15g} {unit} is not allowed; expected values that increase"
        )
    return table


def _factor(unit: str | None, target: str, name: str, path: Path) -> float:
    allowed = f"expected {_ALLOWED.get(target, f'{target} or a unit that converts to it')}"
    if unit is None:
        if target in ("rad", "Pa"):
            raise InputError(f"{path}: {name}: without a unit; {allowed}")
        return 1.0
    try:
        return conversion(unit, target)
    except ValueError:
        raise InputError(f"{path}: {name}: unit {unit!r} is not allowed; {allowed}") from None


_Columns = dict[str, tuple[np.ndarray, str | None]]
"""Values and units of the columns that are expected, by name."""


def _csv(path: Path, expected: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """The columns, and the heads of all of the table's."""
    text = read_text(path, "a table, CSV or NetCDF")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        rows = list(csv.reader(lines, strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV table ({error})") from None
    if not rows:
        raise InputError(f"{path}: empty; expected a head and numbers: {', '.join(expected)}")
    heads = [_HEAD.fullmatch(cell) for cell in rows[0]]
    names = [head[1] if head else "" for head in heads]
    units = [head[2] if head else None for head in heads]
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice:
        raise InputError(f"{path}: column {twice} twice; expected each once")
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(names):
            raise InputError(
                f"{path}: {len(row)} values in row {number}; expected {len(names)}, as in its head"
            )
    columns = {}
    for index, (name, unit) in enumerate(zip(names, units, strict=True)):
        if name in expected:
            cells = enumerate((row[index] for row in rows[1:]), 1)
            columns[name] = np.array([_number(cell, name, row, path) for row, cell in cells]), unit
    return columns, rows[0]


def _number(cell: str, name: str, row: int, path: Path) -> float:
    try:
        return float(cell)
    except ValueError:
        raise InputError(
            f"{path}: {name}: {cell.strip()[:40]!r} in row {row} is not allowed; expected a number"
        ) from None


def _netcdf(path: Path, expected: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """The columns, and the names of all variables."""
    columns: _Columns = {}
    with open_netcdf(path) as data:
        heads = [str(name) for name in data.variables]
        for name in expected:
            if name not in data.variables:
                continue
            variable = data[name]
            if variable.ndim != 1 or variable.dtype.kind not in "iuf":
                raise InputError(
                    f"{path}: {name}: {variable.dtype} of {variable.ndim} dimensions is not "
                    "allowed; expected numbers along one"
                )
            values = load_variable(variable, path).values.astype(float)
            unit = variable.attrs.get("units")
            if name == TIME and unit is not None:
                unit = count_unit(unit, f"{path}: {name}")
            columns[name] = values, None if unit is None else str(unit)
    sizes = {len(values) for values, _ in columns.values()}
    if len(sizes) > 1:
        raise InputError(
            f"{path}: {', '.join(columns)} have {sorted(sizes)} values; expected equally many"
        )
    return columns, heads
