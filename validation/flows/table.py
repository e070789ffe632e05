"""The table of all families: one line for each family and condition, in parallel processes."""

import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from ..report import Check, Row
from .families import BY_NAME, Family, Purpose, chosen
from .images import Condition, conditions_of
from .measure import (
    FAR_VARIANCE,
    LEAST_VALID,
    METHODS,
    OTHERS,
    TOLERANCE,
    VARIANCE,
    WITHIN_ONE,
    Accuracy,
    measured,
    missing,
)

TITLE = "Winds of families of flows, some of which only judge"
INTRODUCTION = (
    "Image pairs of exactly known winds, 219 x 139 px of 0.5 m, 0.1 s apart: the texture is a "
    "function of position, evaluated at the point that the air of a pixel came from. The families "
    "are split in two halves, because standard errors that hold for the flows with which a method "
    "was developed may not hold for others. Families that *build* may be used to choose constants "
    "and defaults. Families that *judge* take part in no such choice, and have kinds of flow that "
    "the others lack. Flow, texture and noise are drawn anew for every seed, and uncertainties "
    "are the scatter over seeds (at least that over blocks of 20 m).\n\n"
    "Texture has an rms of 20 % and a Gaussian autocorrelation of 3 px (coarse: 6 px; power law: "
    "waves of 1.5 to 40 m with k^-5/3); smoke is in patches with rims of a pixel. Noise is white, "
    "a fraction of the mean; *known*: the retrieval is given its standard deviation; *map*: it is "
    "given that of each pixel. *Replaced*: fraction of the variance of the texture that belongs "
    "to unrelated air in image 2. Cases with replaced texture, with blur (which is known) and "
    "with other textures have 1 % of known noise.\n\n"
    f"A row is inside the limits where {100 * WITHIN_ONE:.0f} ± {100 * TOLERANCE:.0f} % of the "
    f"errors are within one standard error and the variance of the normalised errors is "
    f"{VARIANCE[0]:g} to {VARIANCE[1]:g}; it is resolved if its uncertainties are below half of "
    "these limits, or if it is outside by more than twice its uncertainty. Rows with less than "
    f"{100 * LEAST_VALID:.0f} % of valid vectors are flagged and not judged."
)
LEAST_INSIDE = 0.85
"""Fraction of rows that is required to be inside each of the limits."""
SEEDS = {1: 1, 16: 4}
"""Of families that judge, by the effort: one seed shows in minutes what is far out."""

Case = tuple[Family, Condition]
Line = tuple[Case, list[Accuracy]]
WORDS: dict[Purpose, str] = {"build": "Families that build", "judge": "Families that judge"}


def flows(effort) -> Check:
    """How many rows are inside the limits, and the table of all numbers as text."""
    methods = [*METHODS, *(name for name in OTHERS if not missing(name))]
    seeds = SEEDS[effort.scale]
    cases = [(f, c) for f in chosen(effort.purpose) for c in conditions_of(f)]
    found = list(lines(cases, methods, seeds))
    options = "".join(
        [
            " --slow" if effort.scale > 1 else "",
            f" --purpose {effort.purpose}" * bool(effort.purpose),
        ]
    )
    parts = [
        f"Written by `python -m validation flows{options}`, seeds 1 to {seeds} of families "
        "that judge, seed 1 of those that build. "
        + " ".join(f"{name}: {missing(name)}." for name in OTHERS if missing(name)),
        summary(found),
    ]
    parts += [
        f"### {words}\n\n{LEGEND}\n\n{markdown(part)}"
        for purpose, words in WORDS.items()
        if (part := [line for line in found if line[0][0].purpose == purpose])
    ]
    return Check("Families of flows", "\n\n".join(parts), tuple(required(found)))


def lines(cases: Sequence[Case], methods: Sequence[str], seeds: int) -> Iterator[Line]:
    """Rows of all methods, case by case, each case in one process."""
    names = [(family.name, condition) for family, condition in cases]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(_measured, *name, tuple(methods), seeds) for name in names]
        for done, (case, future) in enumerate(zip(cases, futures, strict=True), 1):
            found = future.result()
            text = f"{done} of {len(cases)}: {case[0].name}, {case[1].name}"
            print(text, file=sys.stderr, flush=True)
            yield case, found


def _measured(family: str, condition: Condition, methods, seeds: int) -> list[Accuracy]:
    """By the family's name: flows are no data that another process could be sent."""
    judges = BY_NAME[family].purpose == "judge"
    return measured(BY_NAME[family], condition, methods, range(1, (seeds if judges else 1) + 1))


def of(found: Sequence[Line], method: str, purpose: Purpose) -> list[Accuracy]:
    """Rows of a method and a purpose, in which it has standard errors."""
    return [
        row
        for (family, _), rows in found
        if family.purpose == purpose
        for row in rows
        if row.method == method
    ]


def required(found: Sequence[Line]) -> Iterator[Row]:
    """What is required of the fractions of rows inside the limits, of all methods."""
    for purpose in WORDS:
        for method in METHODS:
            judged = [row for row in of(found, method, purpose) if row.judged]
            if not judged:
                continue
            name = f"{purpose}, {method}"
            for words, inside in (
                ("variance", [row.variance_inside for row in judged]),
                ("68 %", [row.coverage_inside for row in judged]),
            ):
                yield Row(
                    f"{name}: fraction of rows with {words} inside",
                    "required",
                    1.0,
                    np.mean(inside),
                    tolerance=1 - LEAST_INSIDE,
                )
            yield Row(
                f"{name}: largest factor of a variance, logarithm",
                "required",
                0.0,
                max(abs(np.log(row.variance[0])) for row in judged),
                tolerance=np.log(FAR_VARIANCE[1]),
            )


def summary(found: Sequence[Line]) -> str:
    """Markdown table: how many rows of each method and purpose are inside."""
    heads = (
        "families",
        "method",
        "rows judged",
        "variance inside",
        "68 % inside",
        "both inside",
        f"variance {FAR_VARIANCE[0]:g} to {FAR_VARIANCE[1]:g}",
        "resolved",
        "flagged",
    )
    table = [f"| {' | '.join(heads)} |", "| --- | --- |" + " ---: |" * (len(heads) - 2)]
    for purpose in WORDS:
        for method in METHODS:
            rows = of(found, method, purpose)
            judged = [row for row in rows if row.judged]
            if not rows:
                continue

            def percent(is_so, judged=judged):
                return f"{100 * np.mean([is_so(row) for row in judged]):.0f} %" if judged else "-"

            cells = [
                purpose,
                method,
                str(len(judged)),
                percent(lambda row: row.variance_inside),
                percent(lambda row: row.coverage_inside),
                percent(lambda row: row.inside),
                percent(lambda row: not row.far),
                percent(lambda row: row.resolved),
                str(len(rows) - len(judged)),
            ]
            table.append(f"| {' | '.join(cells)} |")
    return "\n".join(table)


LEGEND = (
    "For each method: valid vectors (%), rms error / rms standard error (m/s), within 1 / 1.96 "
    "standard errors (%), variance of the normalised errors; of other programs the rms error "
    "(m/s). Wind: rms, the error without any skill. Bold: outside the limits; with a question "
    "mark: not resolved."
)


def markdown(found: Sequence[Line]) -> str:
    """One line for each family and condition, a group of columns for each method."""
    columns = ("valid", "error / stated", "within", "variance")
    heads = ["flow", "images", "wind"]
    heads += [
        f"{method}: {columns[0]}" if n == 0 else columns[n] for method in METHODS for n in range(4)
    ]
    heads += list(OTHERS)
    table = [f"| {' | '.join(heads)} |", "| --- | --- |" + " ---: |" * (len(heads) - 2)]
    previous = None
    for (family, condition), rows in found:
        by_method = {row.method: row for row in rows}
        name = f"**{family.name}**: {family.what}" if family is not previous else ""
        cells = [name, condition.name, f"{rows[0].wind:.1f}"]
        for method in METHODS:
            cells += _cells(by_method[method]) if method in by_method else ["-"] * 4
        cells += [f"{by_method[name].rmse:.2f}" if name in by_method else "-" for name in OTHERS]
        table.append(f"| {' | '.join(cells)} |")
        previous = family
    return "\n".join(table)


def _cells(row: Accuracy) -> list[str]:
    valid = f"{100 * row.valid:.0f}"
    if not row.judged:
        return [valid, "flagged", "", ""]
    doubt = "" if row.resolved else "?"
    within = f"{100 * row.coverage_68[0]:.0f} / {100 * row.coverage_95[0]:.0f}"
    variance = f"{row.variance[0]:.2f} ± {row.variance[1]:.2f}{doubt}"
    return [
        valid,
        f"{row.rmse:.2f} / {row.stated:.2f}",
        within if row.coverage_inside else f"**{within}**",
        variance if row.variance_inside else f"**{variance}**",
    ]
