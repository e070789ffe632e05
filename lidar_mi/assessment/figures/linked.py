"""Figures whose points are links: SVG for a page, drawn by matplotlib, with one link per point."""

import io
import re
import textwrap
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.alt_text import alt_text


class Mark(NamedTuple):
    """A point of a figure: a dot at the middle, or a cell.

    point: number of the point, for what the page says of it.
    x, y: ends of the cell, in data; equal ends: a dot.
    text: what it shows, as text.
    """

    point: int
    x: tuple[float, float]
    y: tuple[float, float]
    text: str
    colour: str
    link: str


def panel(title: str) -> tuple[Figure, Axes]:
    """A figure of one panel, as wide as a phone; pages put several side by side."""
    figure = Figure(figsize=(5.2, 3.7), dpi=72, layout="constrained")
    axes = figure.subplots()
    axes.set_title(wrapped(title, 55), fontsize=10)
    return figure, axes


def wrapped(text: str, width: int = 34) -> str:
    """A label in lines that fit beside a panel; as it is where it has no spaces."""
    return textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)


def as_svg(axes: Axes, marks: Sequence[Mark], label: str) -> str:
    """The axes' figure as an SVG element with marks below its lines; all text is escaped."""
    figure = axes.figure
    assert isinstance(figure, Figure)  # that of `panel`
    spoken = ". ".join(part for part in (label.strip(" ,"), alt_text(figure)) if part)
    # cells and dots are behind the frame
    figure.patch.set_visible(False)
    axes.patch.set_visible(False)
    text = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": f"{spoken}{marks}"}):
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})
    svg = text.getvalue()
    height = float(figure.get_figheight() * 72)
    # names of groups are the same in every figure
    body = re.sub(r'<g id="[^"]*"', "<g", svg[svg.index("<svg") :])
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    size = re.search(r'viewBox="([^"]*)"', body)
    # an element that contains links is no image
    role = "group" if marks else "img"
    start = f'<svg viewBox="{size[1] if size else ""}" role="{role}" aria-label="{escape(spoken)}">'
    drawn = "".join(_element(axes, mark, height) for mark in marks)
    return f"{start}<g>{drawn}</g>{body[body.index('>') + 1 :]}"


def _element(axes: Axes, mark: Mark, height: float) -> str:
    (x0, y0), (x1, y1) = axes.transData.transform(list(zip(mark.x, mark.y, strict=True)))
    if mark.x[0] == mark.x[1]:
        shape = f'<circle cx="{x0:.1f}" cy="{height - y0:.1f}" r="3.2"'
    else:
        left, top = min(x0, x1), height - max(y0, y1)
        shape = (
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{abs(x1 - x0):.1f}" '
            f'height="{abs(y1 - y0):.1f}"'
        )
    text = f"<title>{escape(mark.text)}</title>"
    end = "</circle>" if shape.startswith("<circle") else "</rect>"
    # stroked, as otherwise the page shows between cells
    return (
        f'<a href="{escape(mark.link)}" data-point="{mark.point}">'
        f'{shape} fill="{mark.colour}" stroke="{mark.colour}">{text}{end}</a>'
    )
