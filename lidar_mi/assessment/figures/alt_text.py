"""Alternative text of a figure, read off what was drawn: panels, ranges, largest values."""

import re
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import Collection, QuadMesh
from matplotlib.container import BarContainer, ErrorbarContainer
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver

TRUE_CORE = "true core"
"""Prefix of the labels of true vortices."""

_MOST_LINES = 8


def alt_text(figure: Figure) -> str:
    """Panels of a figure with their ranges, largest values and places, in sentences."""
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    texts = [_panel(axes) for axes in panels if axes.axison]
    return " ".join(text for text in texts if text)


def _panel(axes: Axes) -> str:
    title = " ".join(filter(None, (axes.get_title(loc="left"), axes.get_title())))
    parts = list(_parts(axes)) or [
        f"{_axis(label)} from {_number(low)} to {_number(high)}"
        for label, (low, high) in (
            (axes.get_xlabel(), sorted(axes.get_xlim())),
            (axes.get_ylabel(), sorted(axes.get_ylim())),
        )
    ]
    text = "; ".join(parts)
    return _plain(f"{title}: {text}." if title else f"{text[:1].upper()}{text[1:]}.")


def _parts(axes: Axes) -> Iterator[str]:
    for artist in axes.collections:
        if isinstance(artist, Quiver):
            yield from _arrows(artist)
        elif not isinstance(artist, ContourSet) and artist.get_array() is not None:
            yield from _colours(axes, artist)
    for image in axes.images:
        yield from _colours(axes, image)
    cores = [line for line in axes.lines if TRUE_CORE in str(line.get_label())]
    drawn = [np.asarray(core.get_xydata()) for core in cores]
    places = np.array([points[0] for points in drawn if len(points)])
    if places.size:
        yield f"true cores at {_places(places)}"
    lines = list(_lines(axes, cores))
    ranges = [f"{name} from {_number(low)} to {_number(high)}" for name, low, high in lines]
    if ranges:
        more = len(ranges) - _MOST_LINES
        others = f" and {more} more" if more > 0 else ""
        label = axes.get_ylabel()
        yield f"{f'{_axis(label)}: ' if label else ''}{', '.join(ranges[:_MOST_LINES])}{others}"
    for bars in axes.containers:
        if isinstance(bars, BarContainer) and len(bars):
            values = np.asarray(bars.datavalues, dtype=float)
            if np.isfinite(values).any():
                low, high = np.nanmin(values), np.nanmax(values)
                yield f"{len(bars)} bars from {_number(low)} to {_number(high)}"


def _arrows(arrows: Quiver) -> Iterator[str]:
    length = np.ma.filled(np.ma.hypot(arrows.U, arrows.V), np.nan).astype(float).ravel()
    finite = np.isfinite(length)
    if finite.any():
        k = int(np.nanargmax(length))
        place = _places(np.asarray(arrows.XY)[k][None])
        yield f"{finite.sum()} arrows, the longest {_number(length[k])} m/s at {place}"


def _colours(axes: Axes, drawn: Collection | AxesImage) -> Iterator[str]:
    values: np.ndarray = np.ma.filled(np.ma.asarray(drawn.get_array(), dtype=float), np.nan)
    if not np.isfinite(values).any():
        return
    bar = drawn.colorbar
    label = _axis(bar.ax.get_ylabel() or bar.ax.get_xlabel()) if bar else "colours"
    text = f"{label} from {_number(np.nanmin(values))} to {_number(np.nanmax(values))}"
    if isinstance(drawn, QuadMesh):
        row, column = np.unravel_index(np.nanargmax(values), values.shape)
        corners = np.asarray(drawn.get_coordinates())[row : row + 2, column : column + 2].reshape(
            -1, 2
        )
        if "y / m" in axes.get_xlabel() and "z / m" in axes.get_ylabel():
            text += f", largest at {_places(corners.mean(0)[None])}"
    yield text


def _lines(axes: Axes, cores: list[Line2D]) -> Iterator[tuple[str, float, float]]:
    """Name and range of every named line and of every row of values with error bars."""
    labelled = [(str(line.get_label()), line) for line in axes.lines if line not in cores]
    for group in axes.containers:
        if isinstance(group, ErrorbarContainer) and group.lines[0] is not None:
            labelled.append((str(group.get_label()), group.lines[0]))
    for name, line in labelled:
        values = np.asarray(line.get_ydata(), dtype=float)
        if not name.startswith("_") and np.isfinite(values).any():
            yield name, float(np.nanmin(values)), float(np.nanmax(values))


def _places(places: np.ndarray) -> str:
    return " and ".join(f"({_number(y)} m, {_number(z)} m)" for y, z in places)


def _axis(label: str) -> str:
    """A label without its remarks in brackets; a unit alone is one of speed."""
    return re.sub(r" \((?!m)[^)]*\)", "", label) or "colours"


def _number(value: float) -> str:
    return f"{float(value):.3g}".replace("-0", "0") if value == 0 else f"{float(value):.3g}"


def _plain(text: str) -> str:
    """Without the signs of formulas."""
    text = re.sub(r"m\$\^2\$ s\$\^\{-1\}\$", "m²/s", text)
    text = re.sub(r"(\w+) s\$\^\{-1\}\$", r"\1/s", text)
    return " ".join(re.sub(r"[\$\{\}]", "", text).split())
