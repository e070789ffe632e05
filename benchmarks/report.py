"""The result of a comparison, as a table and as JSON."""

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Literal

from rich.console import Console
from rich.table import Table

PACKAGES = (
    "lidar-mi",
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "mitransient",
    "OpenPIV",
    "opencv-python-headless",
    "scikit-image",
)


@dataclass(frozen=True)
class Row:
    """One quantity on both sides.

    Attributes
    ----------
    case, quantity, unit : str
    ours, other : float or None
        Medians over the turns; None where a side has none.
    ratio : float or None
        Factor by which lidar-mi is better (above 1: better), median over the turns; None where
        neither more nor less of the quantity is better.
    ratio_range : (float, float) or None
        Smallest and largest ratio of a turn.
    note : str
    """

    case: str
    quantity: str
    unit: str
    ours: float | None
    other: float | None = None
    ratio: float | None = None
    ratio_range: tuple[float, float] | None = None
    note: str = ""


@dataclass(frozen=True)
class Comparison:
    """A table: its rows and the notes needed to read them, or the reason why it has none."""

    title: str
    ours: str
    other: str
    rows: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()
    reason: str = ""


def row(
    case: str,
    quantity: str,
    unit: str,
    ours: Sequence[float],
    other: Sequence[float] = (),
    better: Literal["lower", "higher", ""] = "",
    note: str = "",
) -> Row:
    """A row from measurements turn by turn; ``better`` gives the direction of the ratio.

    A side measured once is compared with every turn of the other.
    """
    ours, other = list(ours), list(other)
    ratio = spread = None
    if better and ours and other:
        turns = max(len(ours), len(other))
        left, right = (v * turns if len(v) == 1 else v for v in (ours, other))
        pairs = (
            zip(right, left, strict=True) if better == "lower" else zip(left, right, strict=True)
        )
        ratios = [a / b for a, b in pairs]
        ratio = median(ratios)
        spread = (min(ratios), max(ratios)) if turns > 1 else None
    middle = [median(side) if side else None for side in (ours, other)]
    return Row(case, quantity, unit, *middle, ratio, spread, note)


def missing(*packages: str) -> str:
    """Reason for which a comparison is skipped if a package is missing; empty if none is."""
    absent = [name for name in packages if find_spec(name) is None]
    return f"skipped: pip install {' '.join(absent)}" if absent else ""


def show(comparison: Comparison, console: Console) -> None:
    """Print a comparison as a table, its notes below."""
    table = Table(title=comparison.title, title_justify="left", title_style="bold")
    if comparison.reason:
        table.show_header = False
        table.add_row(comparison.reason)
        console.print(table)
        return
    table.add_column("quantity")
    alone = not comparison.other
    columns = [comparison.ours, comparison.other, "ratio", "range of ratio"]
    for name in columns[:1] if alone else columns:
        table.add_column(name, justify="right")
    table.add_column("remark")
    case = None
    for line in comparison.rows:
        if line.case != case:
            if case is not None:
                table.add_section()
            table.add_row(f"[bold]{line.case}[/bold]")
            case = line.case
        spread = line.ratio_range
        cells = [
            number(line.ours),
            number(line.other),
            f"[bold]{number(line.ratio)}[/bold]",
            f"{number(spread[0])} ... {number(spread[1])}" if spread else "",
        ]
        quantity = f"  {line.quantity}, {line.unit}" if line.unit else f"  {line.quantity}"
        table.add_row(quantity, *(cells[:1] if alone else cells), line.note)
    console.print(table)
    for note in comparison.notes:
        console.print(f"  {note}", style="dim", highlight=False)
    console.print()


def as_json(comparisons: Mapping[str, Comparison]) -> str:
    """All comparisons with the machine and the versions they were made with."""
    content = {
        "machine": {
            "system": platform.platform(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
        "versions": {name: version_of(name) for name in PACKAGES},
        "ratio": "how many times better lidar-mi is: above 1 better, below 1 worse",
        "comparisons": {name: asdict(found) for name, found in comparisons.items()},
    }
    return json.dumps(_finite(content), indent=1, allow_nan=False) + "\n"


def write_json(comparisons: Mapping[str, Comparison], path: Path) -> None:
    """Write `as_json` to a file, complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_text(as_json(comparisons))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def number(value: float | None) -> str:
    """Three digits."""
    if value is None or not math.isfinite(value):
        return ""
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{float(f'{value:.3g}'):,.0f}"


def version_of(package: str) -> str | None:
    """Of an installed package; None: it is absent."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _finite(value):
    """The same with None in place of numbers JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
