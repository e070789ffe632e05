"""Small tables of numbers, as text and as HTML: what results show of themselves."""

import math
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True)
class Table:
    """Rows of text under a title; heads, and a note below, are optional."""

    title: str
    rows: Sequence[Sequence[str]]
    heads: Sequence[str] = ()
    note: str = ""


class Tabular:
    """A result that shows itself as tables, on a terminal and in a notebook."""

    def tables(self) -> list[Table]:
        """The numbers that are asked for first."""
        raise NotImplementedError

    def thumbnail(self) -> bytes | None:
        """A small PNG image of it, for notebooks; None: it has none."""
        return None

    def __repr__(self) -> str:
        return as_text(self.tables())

    def __str__(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        return as_html(self.tables(), self.thumbnail())


def shown_part(number: int, step: int, noun: str) -> str:
    """Which rows of a thinned table are shown: "every 3rd of 36 heights".

    Examples
    --------
    >>> shown_part(36, 3, "height"), shown_part(40, 2, "scan"), shown_part(9, 1, "height")
    ('every 3rd of 36 heights', 'every 2nd of 40 scans', 'all 9 heights')
    """
    if step == 1:
        return f"all {number} {noun}s"
    ending = {1: "st", 2: "nd", 3: "rd"}.get(step % 10 if step % 100 // 10 != 1 else 0, "th")
    return f"every {step}{ending} of {number} {noun}s"


def with_error(value: float, stderr: float, unit: str = "") -> str:
    """A number and its standard error, both to two digits of the latter: ``312.4 ± 5.1 m²/s``.

    A standard error that is not finite or not above 0 is left out.
    """
    if not math.isfinite(value):
        shown = "-"
    elif math.isfinite(stderr) and stderr > 0:
        decimals = max(0, 1 - math.floor(math.log10(stderr)))
        shown = f"{value:.{decimals}f} ± {stderr:.{decimals}f}"
    else:
        shown = f"{value:.4g}"
    return f"{shown} {unit}".rstrip()


def as_text(tables: Iterable[Table]) -> str:
    """Tables one below the other, columns aligned: the first to the left, others to the right."""
    blocks = []
    for table in tables:
        lines = [*([table.heads] if table.heads else []), *table.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        aligned = (
            "  ".join(
                cell.rjust(width) if k and table.heads else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(line, widths, strict=True))
            )
            for line in lines
        )
        note = [table.note] if table.note else []
        blocks.append("\n".join([table.title, *(f"  {line}".rstrip() for line in aligned), *note]))
    return "\n".join(blocks)


def as_html(tables: Iterable[Table], image: bytes | None = None) -> str:
    """The same for a notebook, with a PNG image before them."""
    parts = []
    if image is not None:
        source = b64encode(image).decode()
        parts.append(f'<img alt="" style="max-width: 100%" src="data:image/png;base64,{source}">')
    for table in tables:
        head = "".join(f"<th>{escape(cell)}</th>" for cell in table.heads)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
            for row in table.rows
        )
        parts.append(
            f"<table><caption>{escape(table.title)}</caption>"
            + (f"<thead><tr>{head}</tr></thead>" if head else "")
            + f"<tbody>{body}</tbody></table>"
            + (f"<p>{escape(table.note)}</p>" if table.note else "")
        )
    return "".join(parts)
