"""The figure of several variants of one experiment side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.alt_text import TRUE_CORE
from lidar_mi.assessment.figures.panels import Drawn, Progress, coloured, save_all
from lidar_mi.assessment.labels import BACKSCATTER

_SPEED = "m s$^{-1}$"


def draw_comparison(
    folder: Path,
    rows: Mapping[str, tuple[xr.DataArray, xr.Dataset, Sequence[tuple[float, float]]]],
    log: Progress,
) -> list[Drawn]:
    """One row per variant: its first image, the w retrieved from the pair, and its error.

    ``rows`` are (image, winds, cores) by variant: attenuated backscatter (m^-1 sr^-1) and winds on
    (z, y), these with w_true and flag; positions (y, z) of the true cores, m.
    """
    figure = Figure(figsize=(19, 4.0 * len(rows)), layout="compressed")
    axes = figure.subplots(len(rows), 3, squeeze=False)
    limit = max(float(abs(wind["w_true"]).quantile(0.995)) for _, wind, _ in rows.values()) or 1.0
    speeds = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    errors = {
        name: (wind["w"] - wind["w_true"]).where(wind["flag"] == 0)
        for name, (_, wind, _) in rows.items()
    }
    largest = [
        float(abs(error).quantile(0.99)) for error in errors.values() if error.notnull().any()
    ]
    # the scale must not be that of a variant without skill
    top = min(float(np.median(largest)) if largest else 0.0, limit) or limit
    for row, (name, (image, wind, cores)) in zip(axes, rows.items(), strict=True):
        low, high = (float(1e6 * image.quantile(q)) for q in (0.002, 0.998))
        valid, place = (
            wind["flag"] == 0,
            {axis: slice(wind[axis][0], wind[axis][-1]) for axis in "yz"},
        )
        columns: tuple[tuple[xr.DataArray, dict[str, Any], str, str], ...] = (
            (
                1e6 * image.sel(place),
                {"cmap": "cividis", "vmin": low, "vmax": high},
                f"{name}: image",
                BACKSCATTER,
            ),
            (wind["w"].where(valid), speeds, f"{name}: w retrieved", _SPEED),
            (errors[name], speeds | {"vmin": -top, "vmax": top}, f"{name}: error of w", _SPEED),
        )
        for panel, (field, style, title, label) in zip(row, columns, strict=True):
            if not field.notnull().any():
                panel.remove()
                continue
            y, z = field["y"].values, field["z"].values
            mesh = coloured(panel, field, **style)
            panel.set(title=title, aspect="equal", xlim=(y.max(), y.min()), ylim=(z.min(), z.max()))
            for core in cores:
                panel.plot(*core, "k+", ms=8, label=f"_{TRUE_CORE}")
            figure.colorbar(mesh, ax=panel, label=label, pad=0.02, extend="both")
        row[0].set_ylabel("z / m")
    for column in axes.T:
        for panel in [panel for panel in column if panel in figure.axes][-1:]:
            panel.set_xlabel("y / m (port is left)")
    caption = (
        "Each variant's first image, the vertical wind retrieved by its first method (white: "
        "flagged vectors), and its error; winds are on one scale, errors on another, that of the "
        "middle variant. Crosses: true cores. Of several gates the first, of winds in three "
        "dimensions the layer nearest to it."
    )
    without = [name for name, error in errors.items() if not error.notnull().any()]
    if without:
        caption += f" Without a valid vector, and so by its image alone: {', '.join(without)}."
    plate = ("fig00_comparison", "The variants side by side", (figure, caption))
    return save_all(folder, [plate], log)
