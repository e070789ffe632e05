"""The table of all families of defects: one line for each, a group of columns for each method."""

import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from multiprocessing import get_context

import numpy as np

from ..report import Check, Row
from .families import BY_NAME, Family, chosen
from .measure import FAR, METHODS, MOST_FAR, MOST_LOST, Outcome, methods_of, outcome

TITLE = "Images that break what retrievals assume"
INTRODUCTION = (
    "Images of 96 x 112 px and volumes of 28^3 voxels of exactly known motion (1 to 2 px, "
    "gradients of 0.01 px per px; `vortex_fit`: a pair of vortices), with defects and noises drawn "
    "anew for every seed. Families that *judge* take part in no choice of a test or threshold; "
    "those that *build* (`--purpose build`) may. `ws` states no errors, so that none of its "
    "vectors is valid. "
    f"Required is that at most {100 * MOST_FAR:g} % of the vectors called valid are more than "
    f"{FAR:g} stated errors from the truth in a component, and that at most {100 * MOST_LOST:g} % "
    "of the vectors of clean images are lost by the checks."
)
SEEDS = {1: 3, 16: 20}
"""By the effort."""
OTHERS = {3: 3, 20: 5}
"""Of the errors of others' vectors, which take half of the time, by those of the methods."""
CLEAN = "none"


def defects(effort) -> Check:
    """What is required of each family and method, and all numbers as text."""
    families = chosen(effort.purpose or "judge")
    families += tuple(f for f in chosen() if f.kind == CLEAN and f not in families)
    seeds = SEEDS[effort.scale]
    return told(measured(families, METHODS, seeds), seeds)


def told(found: Sequence[Outcome], seeds: int) -> Check:
    """Rows of outcomes, and their table."""
    command = f"python -m validation defects{' --slow' * (seeds > SEEDS[1])}"
    each = f"{seeds} seeds each, {OTHERS[seeds]} of `others`"
    text = f"Written by `{command}`, {each}.\n\n{markdown(found)}"
    return Check("Families of defects", text, tuple(required(found)))


def measured(families: Sequence[Family], methods: Sequence[str], seeds: int) -> list[Outcome]:
    """Rows of all families and methods that apply, each in one process."""
    cases = [
        (f.name, m, OTHERS[seeds] if m == "others" else seeds)
        for f in families
        for m in methods_of(f)
        if m in methods
    ]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        found = []
        for row in pool.map(_outcome, *zip(*cases, strict=True)):
            found.append(row)
            print(line(row), file=sys.stderr, flush=True)
    return found


def _outcome(family: str, method: str, seeds: int) -> Outcome:
    """By the family's name: defects are no data that another process could be sent."""
    one = BY_NAME[family]
    loss = one.kind == CLEAN and method != "others"
    return outcome(one, method, range(1, seeds + 1), loss)


def line(row: Outcome) -> str:
    """All numbers, as they come."""
    return (
        f"{row.family:20s} {row.method:11s} {row.valid:5.2f} valid  {row.far:6.3f} far "
        f"({row.seeds_far} of {row.seeds})  error {row.rmse:6.3f} stated {row.stated:6.3f}  "
        f"variance {row.variance:8.2f}  lost {row.lost:5.3f}"
    )


def required(found: Sequence[Outcome]):
    """Fractions of wrong vectors, and of lost ones of clean images."""
    for row in found:
        name = f"{row.family}, {row.method}"
        far = 0.0 if np.isnan(row.far) else row.far
        yield Row(f"{name}: wrong vectors", "required", 0.0, far, tolerance=MOST_FAR)
        if np.isfinite(row.lost):
            yield Row(f"{name}: lost vectors", "required", 0.0, row.lost, tolerance=MOST_LOST)


def markdown(found: Sequence[Outcome]) -> str:
    """Valid (%) and wrong ones of these (%) of each family and method."""
    methods = [m for m in METHODS if any(row.method == m for row in found)]
    heads = ["kind", "images", "purpose", *methods]
    table = [f"| {' | '.join(heads)} |", "| --- | --- | --- |" + " ---: |" * len(methods)]
    for name, rows in groupby(found, key=lambda row: row.family):
        family, by_method = BY_NAME[name], {row.method: row for row in rows}
        cells = [_cell(by_method[m]) if m in by_method else "" for m in methods]
        head = [family.kind, f"**{name}**: {family.what}", family.purpose]
        table.append(f"| {' | '.join([*head, *cells])} |")
    legend = (
        "Valid vectors (%) / those of them that are wrong (%) / variance of normalised errors; of "
        "clean images the lost vectors (%) in brackets. Bold: more than is required. Empty: "
        "not counted."
    )
    return "\n".join(table) + f"\n\n{legend}"


def _cell(row: Outcome) -> str:
    if not row.valid:
        return "flagged"
    wrong = f"{100 * row.far:.1f}"
    text = (
        f"{100 * row.valid:.0f} / {f'**{wrong}**' if row.far > MOST_FAR else wrong} / "
        f"{row.variance:.2g}"
    )
    if np.isfinite(row.lost):
        text += f" ({100 * row.lost:.1f})"
    return text
