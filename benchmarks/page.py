"""The page docs/performance.md: what was measured last, below the text that is written by hand."""

import os
import platform
import re
import textwrap
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import torch

from . import gpu
from .report import PACKAGES, Comparison, number, version_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"
MARK = "<!-- below: written by `make bench` -->"

QUICK: Mapping[str, Mapping[str, Any]] = {
    "velocimetry": {"columns": 110, "rows": 90},
    "rings": {"width": 480, "height": 390},
    "fringes": {"width": 240, "height": 195},
    "transient": {"columns": 40, "rows": 30, "samples": 16},
    "candidates": {"columns": 60, "rows": 40},
    "gradients": {"samples": 4000},
    "gpu": {},
}
"""Comparisons of the page, with the arguments that make them small; JSON has the others, too."""


def write(found: Mapping[str, Comparison], quick: bool) -> None:
    """Replace what follows the mark of `PAGE`.

    Raises
    ------
    ValueError
        The page has no mark.
    """
    text = PAGE.read_text()
    if MARK not in text:
        raise ValueError(f"{PAGE}: no line {MARK!r}")
    PAGE.write_text(text[: text.index(MARK)] + "\n".join([MARK, "", *measured(found, quick)]))


def measured(found: Mapping[str, Comparison], quick: bool) -> list[str]:
    """Lines of the part that is measured: machine, versions, a table for each comparison."""
    command = "make bench ARGS=--quick" if quick else "make bench"
    versions = ", ".join(
        f"{name} {version}" if (version := version_of(name)) else f"{name} absent"
        for name in PACKAGES
    )
    lines = [
        "## Side by side",
        "",
        f"Measured on {date.today().isoformat()} by `{command}`"
        + (" (small cases, few turns)." if quick else "."),
        "Both sides of a ratio take turns in one run; above 1 lidar-mi is better. Where the load",
        "is above the number of cores, wall times are mostly waiting: compare those of all cores.",
        "",
        f"- processor: {processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads",
        f"- load over the last 15 minutes: {load()}",
        f"- GPU: {gpu.absent() or gpu.named()}",
        f"- {versions}",
        "",
    ]
    for comparison in (found[name] for name in QUICK if name in found):
        lines += [f"### {comparison.title}", "", *_table(comparison), ""]
    return lines


def processor() -> str:
    """Its name (Linux; else as Python knows it)."""
    info = Path("/proc/cpuinfo")
    match = re.search(r"model name\s*: (.+)", info.read_text()) if info.is_file() else None
    return match[1].strip() if match else platform.processor() or platform.machine()


def load() -> str:
    """Processes that computed or waited for it, on average."""
    return f"{os.getloadavg()[2]:.0f} processes" if hasattr(os, "getloadavg") else "unknown"


def _table(comparison: Comparison) -> list[str]:
    if comparison.reason:
        return [f"{comparison.reason[0].upper()}{comparison.reason[1:]}."]
    alone = not comparison.other
    sides = [comparison.ours] if alone else [comparison.ours, comparison.other, "ratio", "range"]
    heads = ["case", "quantity", *sides, "remark"]
    lines = [_row(heads), _row(["---"] * len(heads))]
    last = ""
    for line in comparison.rows:
        low_high = line.ratio_range
        spread = f"{number(low_high[0])} to {number(low_high[1])}" if low_high else ""
        values = [number(line.ours), number(line.other), number(line.ratio), spread]
        quantity = f"{line.quantity}, {line.unit}" if line.unit else line.quantity
        case = "" if line.case == last else line.case
        lines.append(_row([case, quantity, *(values[:1] if alone else values), line.note]))
        last = line.case
    notes = (textwrap.wrap(note, 118, subsequent_indent="  ") for note in comparison.notes)
    return [*lines, *(line for one in notes for line in ("", "- " + one[0], *one[1:]))]


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"
