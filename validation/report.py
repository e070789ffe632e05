"""Results of checks: rows, a table on the terminal, files of them and pages made of these."""

import json
import math
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from lidar_mi.io.text import write_text

SIGMAS = 4
"""A row passes within so many standard errors; of 1000 correct ones, 0.06 do not."""

PACKAGES = ("lidar-mi", "mitsuba", "drjit", "numpy", "scipy", "scatrs", "rustmatrix", "miepython")


@dataclass(frozen=True)
class Row:
    """One number compared with its reference.

    Parameters
    ----------
    name, reference : str
        The quantity compared, and the source of ``expected``.
    expected, got : float
    sigma : float
        Standard error of ``got - expected``; 0 for numbers without random error.
    tolerance : float
        Systematic uncertainty of the reference or the comparison: rounding of published digits,
        a stated truncation.
    unit : str

    Raises
    ------
    ValueError
        Neither a standard error nor a tolerance: such a row is meaningless.
    """

    name: str
    reference: str
    expected: float
    got: float
    sigma: float = 0.0
    tolerance: float = 0.0
    unit: str = ""

    def __post_init__(self):
        for name in ("expected", "got", "sigma", "tolerance"):
            object.__setattr__(self, name, float(getattr(self, name)))
        allowed = SIGMAS * self.sigma + self.tolerance
        if not (self.sigma >= 0 and self.tolerance >= 0 and 0 < allowed < math.inf):
            raise ValueError(
                f"{self.name}: sigma {self.sigma}, tolerance {self.tolerance}; "
                "expected numbers >= 0, not both 0"
            )

    @property
    def deviation(self) -> float:
        """In standard errors, or in tolerances where there is no random error."""
        return (self.got - self.expected) / (self.sigma or self.tolerance)

    @property
    def passed(self) -> bool:
        return abs(self.got - self.expected) <= SIGMAS * self.sigma + self.tolerance


@dataclass(frozen=True)
class Comparison:
    """A table of results that have no reference: heads of the columns, cells line by line."""

    heads: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Check:
    """Rows of one topic, with the information needed to read them.

    ``figures`` are the names of PNGs beside the page and their captions; ``name`` is that of the
    function that made it, with its group's.
    """

    title: str
    text: str
    rows: tuple[Row, ...]
    figures: tuple[tuple[str, str], ...] = ()
    name: str = ""
    comparison: Comparison | None = None

    @property
    def passed(self) -> bool:
        return bool(self.rows) and all(row.passed for row in self.rows)


def largest(name: str, reference: str, got, expected, tolerance: float, unit: str = "") -> Row:
    """A row for arrays without random error: their largest difference, expected to be 0."""
    difference = np.asarray(got, float) - np.asarray(expected, float)
    worst = np.abs(difference).max() if np.isfinite(difference).all() else math.nan
    return Row(name, reference, 0.0, worst, 0.0, tolerance, unit)


def mean_and_error(batches) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error over independent batches (first axis)."""
    batches = np.asarray(batches, float)
    return batches.mean(0), batches.std(0, ddof=1) / math.sqrt(len(batches))


def spread(name: str, reference: str, z, batches: float = math.inf) -> Row:
    """Mean square of independent z-scores: sensitive to errors of any of them or of their sigma.

    ``batches`` is the number from which the standard errors are estimated: z then has Student's
    distribution, which is wider than the normal one.
    """
    z = np.asarray(z, float).ravel()
    freedom = batches - 1
    expected, fourth = 1.0, 3.0
    if math.isfinite(batches):
        expected = freedom / (freedom - 2)
        fourth = 3 * freedom**2 / ((freedom - 2) * (freedom - 4))
    sigma = math.sqrt((fourth - expected**2) / z.size)
    return Row(
        f"{name}: mean square of {z.size} z-scores", reference, expected, (z**2).mean(), sigma
    )


def show(check: Check, console: Console) -> None:
    """Print a check as a table."""
    table = Table(title=check.title, title_justify="left", title_style="bold")
    for name, justify in (
        ("", "left"),
        ("expected", "right"),
        ("obtained", "right"),
        ("sigma", "right"),
        ("deviation", "right"),
        ("", "left"),
    ):
        table.add_column(name, justify=justify)
    for row in check.rows:
        verdict = "ok" if row.passed else "[bold red]FAILS[/bold red]"
        table.add_row(*_cells(row), verdict)
    console.print(table)
    if check.comparison:
        # lines that the terminal is too narrow for would lose cells in a drawn table
        console.print("\n".join(_markdown(check.comparison)), soft_wrap=True, highlight=False)


@dataclass(frozen=True)
class Results:
    """What a group of checks found, as it is stored.

    Parameters
    ----------
    title, introduction : str
    command : str
        The command that computes it again.
    checks : tuple of Check
    versions : mapping of str to str
        Of the packages that it was computed with.
    note : str
        On the source of stored references.
    """

    title: str
    introduction: str
    command: str
    checks: tuple[Check, ...]
    versions: dict[str, str]
    note: str = ""


def versions() -> dict[str, str]:
    """Of the packages that matter, as far as they are installed."""
    known = {name: _version(name) for name in PACKAGES}
    return {name: number for name, number in known.items() if number}


def store(results: Results, path: Path) -> None:
    """Write results as JSON; long texts line by line, so that changes can be read."""
    data = asdict(results)
    for check in data["checks"]:
        check["text"] = check["text"].splitlines()
    write(json.dumps(data, indent=1, ensure_ascii=False) + "\n", path)


def load(path: Path) -> Results:
    """Results that `store` wrote."""
    data = json.loads(path.read_text(encoding="utf-8"))
    checks = []
    for check in data.pop("checks"):
        table = check.pop("comparison")
        if table:
            table = Comparison(tuple(table["heads"]), tuple(map(tuple, table["lines"])))
        rows = tuple(Row(**row) for row in check.pop("rows"))
        text, figures = "\n".join(check.pop("text")), tuple(map(tuple, check.pop("figures")))
        checks.append(Check(**check, text=text, rows=rows, figures=figures, comparison=table))
    return Results(**data, checks=tuple(checks))


def page(results: Results) -> str:
    """The page of a group in ``docs/validation``, as GitHub-flavoured Markdown."""
    rows = [row for check in results.checks for row in check.rows]
    failed = sum(not row.passed for row in rows)
    lines = [f"# {results.title}", "", results.introduction, ""]
    if rows:
        fails = f"{failed} fail" if failed else "none fails"
        lines += [f"Written by `{results.command}`. Of {len(rows)} rows, {fails}.", ""]
    for check in results.checks:
        lines += _section(check)
    named = ", ".join(f"{name} {number}" for name, number in results.versions.items())
    lines += [*([results.note, ""] if results.note else []), f"Versions: {named}."]
    return "\n".join(lines) + "\n"


def _section(check: Check) -> list[str]:
    lines = [f"## {check.title}", "", check.text, ""]
    if check.rows:
        lines += [
            "| quantity | expected | obtained | sigma | deviation | | reference |",
            "| --- | ---: | ---: | ---: | ---: | --- | --- |",
        ]
    for row in check.rows:
        verdict = "pass" if row.passed else "**FAIL**"
        cells = [cell.replace("|", "\\|") for cell in (*_cells(row), verdict, row.reference)]
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    if check.comparison:
        lines += [*_markdown(check.comparison), ""]
    for name, caption in check.figures:
        lines += [f"![{caption}]({name})", "", f"*{caption}*", ""]
    return lines


def with_table(text: str, check: Check) -> str:
    """A page written by hand, with the table of a check between the marks of its name.

    A page that has no such marks stays as it is.
    """
    begin, end = (f"<!-- {check.name}: {what} -->" for what in ("begin", "end"))
    before, found, rest = text.partition(begin)
    if check.comparison is None or not found:
        return text
    table = "\n".join(_markdown(check.comparison))
    return f"{before}{begin}\n\n{table}\n\n{end}{rest.partition(end)[2]}"


def _markdown(table: Comparison) -> list[str]:
    rules = ("---",) * len(table.heads)
    return [f"| {' | '.join(cells)} |" for cells in (table.heads, rules, *table.lines)]


def _cells(row: Row) -> list[str]:
    name = f"{row.name}, {row.unit}" if row.unit else row.name
    allowed = f"{row.sigma:.1e}" if row.sigma else f"|{row.tolerance:.1e}|"
    return [name, _number(row.expected), _number(row.got), allowed, f"{row.deviation:+.1f}"]


def _number(value: float) -> str:
    """Six digits."""
    return f"{value:.6g}"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def write(text: str, path: Path) -> None:
    """Write a page, complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
