"""Tables of lines of sight (CSV): one row for each line and gate."""

import re
from collections.abc import Mapping
from io import StringIO
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.lines_of_sight.scan import (
    ANGLES,
    FIELDS,
    PLACE,
    TABLE,
    Scan,
    dated,
    listed,
    ratio_of_powers,
    seconds,
    toward_in_words,
)
from lidar_mi.io.text import read_text
from lidar_mi.units import conversion

_HEAD = re.compile(r"\s*(.*?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*")
_REQUIRED = ("time", "azimuth", "elevation", "range", "radial_velocity")
_UNITS = {
    "time": "s",
    "range": "m",
    **dict.fromkeys(ANGLES, "degree"),
    **{name: unit for name, (unit, _) in FIELDS.items()},
    **{name: "degree" if unit.startswith("degree") else unit for name, (unit, _) in PLACE.items()},
}
_LARGEST = 1 << 30


def read_csv_lines(path: Path, names: Mapping[str, str]) -> Scan:
    """The lines of a table with a head of names and units, such as ``range [m]``.

    names: ours to those of the head, without unit; a minus sign before that of radial_velocity
        turns its sign, a plus sign retains it, whatever comments say of it. Rows of the same time
        and angles are one line; time is ISO 8601 (UTC), seconds since 1970 or as of `dated`;
        ``snr`` may have the unit dB. Lines that begin with # are comments.

    Raises InputError: no table, a column that is missing, a unit that does not convert, a cell that
    is no number, two values for one line and gate.
    """
    import pandas as pd

    text = read_text(path, "a table of lines of sight", _LARGEST)
    head = next((line for line in text.splitlines() if line and not line.startswith("#")), "")
    try:
        separator = max(",;\t", key=head.count)
        table = pd.read_csv(StringIO(text), sep=separator, comment="#", dtype=str)
    except Exception as error:  # any exception of the parser
        raise InputError(f"{path}: not a table ({error}); expected a head and rows") from None
    heads = [_HEAD.fullmatch(str(name)) for name in table.columns]
    units_of = {head[1]: (k, head[2]) for k, head in enumerate(heads) if head}
    columns: dict[str, np.ndarray] = {}
    remarks: list[str] = []
    for ours, unit in _UNITS.items():
        theirs = names.get(ours, ours).lstrip("+-").strip()
        if theirs not in units_of:
            if ours in _REQUIRED or ours in names:
                raise InputError(
                    f"{path}: column {theirs!r} ({ours}) is missing; it has "
                    f"{listed(list(units_of))}; expected names: {{{ours}: its name there}}"
                )
            continue
        index, theirs_unit = units_of[theirs]
        columns[ours], more_remarks = _values(table.iloc[:, index], ours, theirs_unit, unit, path)
        remarks += more_remarks
    if not len(table):
        raise InputError(f"{path}: no row below the head; expected one or more")
    sign = names.get("radial_velocity", "")
    comments = "; ".join(line for line in text.splitlines() if line.startswith("#"))
    toward = not sign.startswith(("+", "-")) and toward_in_words(comments)
    if toward:
        remarks.append(
            "a comment says that radial_velocity is positive toward the lidar: its sign is reversed"
        )
    if toward or sign.startswith("-"):
        columns["radial_velocity"] = -columns["radial_velocity"]
    return _scan(columns, path, remarks)


def _values(  # type: ignore[no-untyped-def]
    cells, ours: str, unit: str | None, target: str, path: Path
) -> tuple[np.ndarray, list[str]]:
    """A column as numbers in our unit, times as datetime64[ns]; remarks."""
    import pandas as pd

    text = cells.str.strip()
    numbers = pd.to_numeric(text, errors="coerce").to_numpy(float)
    unknown = np.isnan(numbers) & ~text.fillna("nan").str.lower().isin(("nan", "", "na")).to_numpy()
    if ours == "time" and unknown.any():
        times = pd.to_datetime(text, errors="coerce", utc=True, format="ISO8601")
        bad = np.flatnonzero(times.isna().to_numpy())
        if not bad.size:
            return times.dt.tz_localize(None).to_numpy().astype("datetime64[ns]"), []
        unknown = times.isna().to_numpy()
    if unknown.any():
        row = int(np.flatnonzero(unknown)[0])
        raise InputError(
            f"{path}: {cells.name}: {text.iloc[row]!r} in row {row + 1} is not allowed; expected "
            f"{'a time (ISO 8601) or seconds' if ours == 'time' else 'a number'}"
        )
    if ours == "snr":
        return ratio_of_powers(numbers, unit or "", str(cells.name))
    if ours == "time" and not unit:
        return dated(numbers, str(cells.name), path)
    if unit:
        try:
            numbers = numbers * conversion(unit, target)
        except ValueError:
            raise InputError(
                f"{path}: {cells.name}: unit {unit!r} is not allowed; expected {target} or a unit "
                "that converts to it"
            ) from None
    return (seconds(numbers, np.datetime64("1970-01-01")) if ours == "time" else numbers), []


def _scan(columns: dict[str, np.ndarray], path: Path, remarks: list[str]) -> Scan:
    """Rows to lines, in the order in which they begin, and gates."""
    keys = np.stack(
        [columns["time"].astype("int64"), *(_codes(columns[a]) for a in ("azimuth", "elevation"))],
        axis=1,
    )
    _, first, line = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    line, first = rank[line.ravel()], first[order]
    ranges, gate = np.unique(columns["range"], return_inverse=True)
    if not np.isfinite(ranges).all():
        raise InputError(f"{path}: range: no finite number in some rows; expected metres")
    place = line * ranges.size + gate.ravel()
    if np.unique(place).size < place.size:
        counts = np.bincount(place)
        row = int(np.flatnonzero(counts[place] > 1)[1])
        raise InputError(
            f"{path}: row {row + 1}: a second value for one line and gate; expected one each"
        )
    fields = {}
    for name in FIELDS:
        if name in columns:
            full = np.full(first.size * ranges.size, np.nan)
            full[place] = columns[name]
            fields[name] = full.reshape(first.size, ranges.size)
    return Scan(
        columns["time"][first],
        {name: columns[name][first] for name in ANGLES if name in columns},
        ranges,
        fields,
        {name: float(columns[name][0]) for name in PLACE if name in columns},
        about={"kind": TABLE},
        remarks=remarks,
    )


def _codes(values: np.ndarray) -> np.ndarray:
    """A whole number for each different value."""
    return np.unique(values, return_inverse=True)[1].ravel().astype("int64")
