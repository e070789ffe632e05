"""Common parts of all figures: files, panels in the pilot's view, logarithmic axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from lidar_mi.assessment.figures.alt_text import TRUE_CORE, alt_text
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.io.folder import make_folder
from lidar_mi.io.png import write_png


class Progress(Protocol):
    """Takes the progress of the figures that are drawn."""

    def bar(self, text: str, fraction: float | None) -> None:
        """The text with a bar; None: of unknown length."""


UNIFORM = 5e-3
"""Relative range of colours below which a field is called uniform."""


Captioned = tuple[Figure, str]
"""A figure and its caption."""


@dataclass(frozen=True)
class Drawn:
    """A figure file with its title, caption and alternative text."""

    path: Path
    title: str
    caption: str
    alt_text: str = ""


def save_all(
    folder: Path, figures: Sequence[tuple[str, str, Captioned]], log: Progress
) -> list[Drawn]:
    """Save figures, each (file name, title, (figure, caption)), as PNG."""
    make_folder(folder)
    drawn = []
    for index, (name, title, (figure, caption)) in enumerate(figures):
        log.bar(f"drawing {title.lower()}", index / len(figures))
        path = folder / f"{name}.png"
        write_png(figure, path, cropped=True)
        drawn.append(Drawn(path, title, caption, alt_text(figure)))
    return drawn


def speed_of(v: xr.DataArray, w: xr.DataArray) -> xr.DataArray:
    """Length of the vectors (v, w)."""
    return xr.apply_ufunc(np.hypot, v, w)


def sheet(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """A figure with panels for slabs as wide as the samples, (rows, columns)."""
    figure = Figure(figsize=(6.8 * columns, 4.3 * rows), layout="compressed")
    return figure, figure.subplots(rows, columns, squeeze=False)


def panels_of(number: int) -> tuple[Figure, list[Axes]]:
    """A figure with this number of panels for slabs, in rows of two or three."""
    columns = 3 if number % 2 and number > 1 else min(number, 2)
    rows = -(-number // columns)
    figure, grid = sheet(rows, columns)
    if columns != 2:
        # one alone has the space of two, three are smaller
        figure.set_size_inches((8.8, 5.6) if columns == 1 else (18, 4.2 * rows))
    for spare in grid.ravel()[number:]:
        spare.remove()
    return figure, list(grid.ravel()[:number])


def frame(
    axes: Axes, y: np.ndarray | xr.DataArray, z: np.ndarray | xr.DataArray, title: str
) -> None:
    """The pilot's view: port on the left, up at the top, metres true to scale."""
    # on the left, as the scale of arrows is on the right
    axes.set_title(title, loc="left")
    pilots_view(axes, y, z)


def pilots_view(axes: Axes, y: np.ndarray | xr.DataArray, z: np.ndarray | xr.DataArray) -> None:
    """Axes and limits of a plane (m): port, of positive y, is left."""
    axes.set(xlabel="y / m (port is left)", ylabel="z / m", aspect="equal")
    axes.set_xlim(float(y.max()), float(y.min()))
    axes.set_ylim(float(z.min()), float(z.max()))


def arrow_scale(axes: Axes, arrows: Quiver, largest: float) -> None:
    """An arrow and its speed, the roundest up to the largest, above a panel on its right."""
    power = 10 ** math.floor(math.log10(largest))
    speed = next(n for n in (5, 2, 1) if n * power <= largest) * power
    axes.quiverkey(
        arrows, 0.93, 1.045, speed, f"{speed:g} m s$^{{-1}}$", labelpos="W", color="black"
    )


def mark_cores(axes: Axes, cores: Sequence[Core], colour: str, size: float = 9) -> None:
    """Crosses where the true vortices are."""
    for core in cores:
        axes.plot(core.y, core.z, "+", color=colour, ms=size, ls="none", label=f"_{TRUE_CORE}")


def coloured(
    axes: Axes, field: xr.DataArray, across: str = "y", up: str = "z", **style: Any
) -> QuadMesh:
    """A field in colours, a cell about each of its nodes."""
    values = field.transpose(up, across).values
    return axes.pcolormesh(
        field[across], field[up], values, shading="nearest", rasterized=True, **style
    )


def image_panel(
    axes: Axes, field: xr.DataArray, title: str, label: str, extend: str = "neither", **style: Any
) -> None:
    """A field (z, y) in colours, with its bar."""
    mesh = coloured(axes, field, **style)
    frame(axes, field["y"], field["z"], title)
    low, high = mesh.get_clim()
    uniform = high - low <= UNIFORM * max(abs(low), abs(high))
    bar = axes.figure.colorbar(
        mesh, ax=axes, label=f"{label}, uniform" if uniform else label, pad=0.02, extend=extend
    )
    if isinstance(bar.formatter, ScalarFormatter):
        # whole numbers, without an offset
        bar.formatter.set_useOffset(False)
    if uniform:
        bar.set_ticks([(low + high) / 2], labels=[f"{(low + high) / 2:.3g}"])


def one_to_one(axes: Axes, label: str, *, logarithmic: bool = False) -> None:
    """The line on which both axes of a panel are the same, with the same scales on both."""
    values = [np.ravel(np.asarray(d, float)) for line in axes.lines for d in line.get_data()]
    drawn = np.concatenate([v[np.isfinite(v) & ((v > 0) | (not logarithmic))] for v in values])
    low, high = float(drawn.min()), float(drawn.max())
    if logarithmic:
        ends = low / 1.15, high * 1.15
        axes.set(xscale="log", yscale="log")
    else:
        ends = low - 0.05 * (high - low), high + 0.05 * (high - low)
    axes.plot(ends, ends, "k--", lw=1, label=label)
    axes.set(xlim=ends, ylim=ends, aspect="equal")
    axes.grid(alpha=0.3, which="both")
    for side in (axes.xaxis, axes.yaxis) if logarithmic else ():
        side.set_major_locator(LogLocator(subs=(1, 2, 5)))
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter(NullFormatter())


def by_factors(axes: Axes) -> None:
    """A logarithmic vertical axis where values differ by more than a factor of 3."""
    values = np.concatenate(
        [np.zeros(0), *(np.ravel(line.get_ydata()).astype(float) for line in axes.lines)]
    )
    values = values[np.isfinite(values) & (values > 0)]
    if values.size and values.max() > 3 * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
