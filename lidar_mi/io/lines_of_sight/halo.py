"""Halo Photonics (StreamLine) text files, ``.hpl``.

A header of names and values ends with ``****``. Each ray has a line of decimal hours, azimuth,
elevation and, of later software, pitch and roll, then a line for every gate: number, velocity
(positive away), SNR + 1, backscatter and, where that is switched on, spectral width.
"""

import re
import warnings
from datetime import datetime
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.lines_of_sight.scan import Scan, seconds
from lidar_mi.io.text import read_text

LARGEST = 1 << 30
"""Most bytes of a file: an hour of a stare has some ten million."""

_KIND = "a Halo Photonics file (.hpl)"
_COLUMNS = ("radial_velocity", "snr", "attenuated_backscatter", "spectral_width")
_LARGEST_GATES = 100_000


def read_halo(path: Path) -> Scan:
    """All rays of a file, whatever number the header states.

    Gates are adjacent, (gate + 1/2) gate lengths away, but for scans that are called overlapping:
    these begin at every sample, gate length over points apart.

    Raises InputError: no header, a value of it that is no number, no ray.
    """
    head, body = _parts(read_text(path, _KIND, LARGEST), path)
    gates = int(_number(head, "Number of gates", path))
    length = _number(head, "Range gate length (m)", path)
    points = _number(head, "Gate length (pts)", path)
    if not (0 < gates <= _LARGEST_GATES and length > 0 and points >= 1):
        raise InputError(
            f"{path}: {gates} gates of {length:g} m and {points:g} points are not allowed; "
            f"expected 1 to {_LARGEST_GATES} gates of a length above 0 m"
        )
    start = _start(head, path)
    rays, values, remarks = _rays(body, gates, path)
    scan_type = head.get("Scan type", "")
    step = length / points if "overlapping" in scan_type.lower() else length
    promised = head.get("No. of rays in file") or head.get("No. of waypoints in file") or ""
    if promised.isdigit() and int(promised) > len(rays):
        remarks.insert(0, f"the header promises {promised} rays, the file has {len(rays)}")
    columns = dict(zip(_COLUMNS, np.moveaxis(values, -1, 0), strict=True))
    columns["snr"] = columns["snr"] - 1.0
    columns = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    columns.setdefault("radial_velocity", np.full(values.shape[:2], np.nan))
    angles = {"azimuth": rays[:, 1], "elevation": rays[:, 2]}
    if np.isfinite(rays[:, 3:]).all():
        angles |= {"pitch": rays[:, 3], "roll": rays[:, 4]}
    about: dict[str, str | float] = {
        "kind": "Halo Photonics (hpl)",
        "instrument": f"Halo Photonics StreamLine {head.get('System ID', '')}".strip(),
        "scan_type": scan_type,
        "gate_length": length,
    }
    for name, key in (
        ("samples_per_gate", "Gate length (pts)"),
        ("pulses_per_line", "Pulses/ray"),
        ("velocity_resolution", "Resolution (m/s)"),
        ("focus_range", "Focus range"),
        ("instrument_spectral_width", "Instrument spectral width"),
    ):
        if key in head:
            about[name] = _number(head, key, path)
    return Scan(
        _times(rays[:, 0], start),
        angles,
        length / 2 + step * np.arange(gates),
        columns,
        about=about,
        remarks=remarks,
    )


def _parts(text: str, path: Path) -> tuple[dict[str, str], list[str]]:
    """Names and values of the header, and the lines below it."""
    stars = re.search(r"^\*{4}(.*)$", text, re.MULTILINE)
    if not stars or stars.start() > 20_000:
        raise InputError(f"{path}: has no line that begins with ****; expected {_KIND}, whole")
    head = {}
    for line in [*text[: stars.start()].splitlines(), stars[1]]:
        name, sign, value = line.partition("=" if "spectral width =" in line else ":")
        if sign:
            head[name.strip()] = value.strip()
    return head, text[stars.end() :].splitlines()


def _number(head: dict[str, str], name: str, path: Path) -> float:
    try:
        value = float(head[name])
    except (KeyError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            f"{path}: header: {name}: {head.get(name, 'missing')!r} is not allowed; expected a "
            "number"
        )
    return value


def _start(head: dict[str, str], path: Path) -> datetime:
    text = head.get("Start time", "missing")
    for form in ("%Y%m%d %H:%M:%S.%f", "%Y%m%d %H:%M:%S"):
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    raise InputError(
        f"{path}: header: Start time: {text!r} is not allowed; expected such as "
        "20210624 17:01:15.65"
    )


def _times(hours: np.ndarray, start: datetime) -> np.ndarray:
    """Times of decimal hours, which restart at midnight: a step back by more than half a day."""
    midnight = datetime(start.year, start.month, start.day)
    first = (start - midnight).total_seconds() / 3600
    days = np.cumsum(np.diff(hours, prepend=first) < -12)
    return seconds((hours + 24.0 * days) * 3600, np.datetime64(midnight))


def _rays(lines: list[str], gates: int, path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Hours and angles (rays, 5), values (rays, gates, 4), NaN where there is none; remarks."""
    lines = [line for line in lines if line.strip()]
    # a gate begins with its whole number, a ray with decimal hours
    starts = [k for k, line in enumerate(lines) if not line.split(None, 1)[0].isdigit()]
    if not starts:
        raise InputError(f"{path}: has no ray below its header; expected one or more")
    stray = starts[0]
    rays, values, invalid = [], [], 0
    partial: list[int] = []
    for begin, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        ray = _floats([lines[begin].split()], 5)
        if not np.isfinite(ray[0, :3]).all():
            stray += end - begin
            continue
        number, table = _gates(lines[begin + 1 : end])
        inside = number < gates
        invalid += int((~inside).sum()) + int((~np.isfinite(table[:, :2])).any(1).sum())
        ray_values = np.full((gates, 4), np.nan)
        ray_values[number[inside]] = table[inside]
        rays.append(ray[0])
        values.append(ray_values)
        if len(set(number[inside].tolist())) < gates:
            partial.append(len(rays))
    if not rays:
        raise InputError(f"{path}: has no ray with a time and two angles; expected one or more")
    remarks = []
    if partial:
        remarks.append(
            f"{len(partial)} of {len(rays)} rays have fewer than {gates} gates, ray {partial[0]} "
            "the first: what is missing is flagged"
        )
    if invalid:
        remarks.append(f"{invalid} gates are no numbers or beyond the {gates} of the header")
    if stray:
        remarks.append(f"{stray} lines belong to no ray with a time and two angles")
    return np.array(rays), np.array(values), remarks


def _gates(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of gates (n,) and their values (n, 4), NaN where there is none."""
    width = len(lines[0].split()) if lines else 0
    if width in (4, 5):
        numbers = _numbers_of(" ".join(lines))
        if numbers.size == width * len(lines):
            numbers = numbers.reshape(-1, width)
            if np.array_equal(numbers[:, 0], np.arange(len(lines))):
                table = np.full((len(lines), 4), np.nan)
                table[:, : width - 1] = numbers[:, 1:]
                return np.arange(len(lines)), table
    words = [line.split() for line in lines]
    words = [row for row in words if len(row[0]) < 9]
    return np.array([int(row[0]) for row in words], int), _floats([row[1:] for row in words], 4)


def _numbers_of(text: str) -> np.ndarray:
    """Numbers of a text, (n,); none if there is a word that is no number."""
    with warnings.catch_warnings():
        # by the version of numpy, a word that is no number ends the reading or is an error
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            return np.fromstring(text, sep=" ")
        except ValueError:
            return np.empty(0)


def _floats(rows: list[list[str]], width: int) -> np.ndarray:
    """Numbers of rows, (rows, width): NaN where a row is shorter or has no number."""
    numbers = np.full((len(rows), width), np.nan)
    size = min(width, min(map(len, rows), default=0))
    try:
        numbers[:, :size] = np.array([row[:size] for row in rows], float).reshape(len(rows), size)
        tails = [(k, row) for k, row in enumerate(rows) if len(row) > size]
    except ValueError:
        size, tails = 0, list(enumerate(rows))
    for k, row in tails if size < width else ():
        for column, word in enumerate(row[size:width], size):
            try:
                numbers[k, column] = float(word)
            except ValueError:
                continue
    return numbers
