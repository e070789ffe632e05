"""Common parts of all figures: files, panels in the pilot's view, logarithmic axes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from lidar_mi.assessment.described import Progress
from lidar_mi.io.folder import make_folder
from lidar_mi.io.png import write_png

UNIFORM = 5e-3
"""Relative range of colours below which a field is called uniform."""


Plate = tuple[Figure, str]
"""A figure and its caption."""


@dataclass(frozen=True)
class Drawn:
    """A figure file and what it shows."""

    path: Path
    title: str
    caption: str


def save_all(folder: Path, plates: Sequence[tuple[str, str, Plate]], log: Progress) -> list[Drawn]:
    """Save plates, each (file name, title, (figure, caption)), as PNG."""
    make_folder(folder)
    drawn = []
    for index, (name, title, (figure, caption)) in enumerate(plates):
        log.bar(f"drawing {title.lower()}", index / len(plates))
        path = folder / f"{name}.png"
        write_png(figure, path, cropped=True)
        drawn.append(Drawn(path, title, caption))
    return drawn


def speed_of(v: xr.DataArray, w: xr.DataArray) -> xr.DataArray:
    """Length of the vectors (v, w)."""
    return xr.apply_ufunc(np.hypot, v, w)


def sheet(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """A figure with panels for slabs as wide as the samples, (rows, columns)."""
    figure = Figure(figsize=(6.8 * columns, 4.3 * rows), layout="compressed")
    return figure, figure.subplots(rows, columns, squeeze=False)


def frame(
    axes: Axes, y: np.ndarray | xr.DataArray, z: np.ndarray | xr.DataArray, title: str
) -> None:
    """The pilot's view: port on the left, up at the top, metres true to scale."""
    axes.set(title=title, xlabel="y / m (port is left)", ylabel="z / m", aspect="equal")
    axes.set_xlim(float(y.max()), float(y.min()))
    axes.set_ylim(float(z.min()), float(z.max()))


def image_panel(
    axes: Axes, field: xr.DataArray, title: str, label: str, extend: str = "neither", **style: Any
) -> None:
    """A field (z, y) in colours, with its bar."""
    y, z = field["y"], field["z"]
    mesh = axes.pcolormesh(
        y, z, field.transpose("z", "y").values, shading="nearest", rasterized=True, **style
    )
    frame(axes, y, z, title)
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
