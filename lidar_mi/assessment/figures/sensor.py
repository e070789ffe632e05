"""The figures of both lidars as one sensor: its scan, its wind, its standard errors."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.normalised_errors import (
    draw_normal_density,
    draw_normalised_errors,
)
from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    coloured,
    mark_cores,
    save_all,
)
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.retrieval.combined.vectors import COMPONENTS, line_places

_SPEED = "m s$^{-1}$"


def draw_all(
    folder: Path, wind: xr.Dataset | None, lines: xr.Dataset, cores: Sequence[Core], log: Progress
) -> list[Drawn]:
    """Draw the combined sensor's figures as PNG into ``folder``.

    The wind is that of `combined.combine.combine`, with the truth as u_true, v_true, w_true, the
    lines of `lidar_mi.experiment.stages.lines.measure_lines`.
    """
    figures = [("fig19_lines_of_sight", "The scan of the Doppler lidar", _scan(lines, cores))]
    if wind is not None:
        figures = [
            ("fig20_wind3d", "The wind from both lidars", _maps(wind, lines, cores)),
            *figures,
            ("fig21_uncertainty", "Standard errors of the wind", _uncertainty(wind)),
        ]
    return save_all(folder, figures, log)


def _scan(lines: xr.Dataset, cores: Sequence[Core]) -> Captioned:
    place = line_places(lines)
    speed, true = lines["v_los"].values, lines["v_los_true"].values
    normalised = (speed - true) / lines["v_los_std"].values
    read = np.isfinite(speed)
    # without velocities only the places of the lines are drawn
    figure = Figure(figsize=(13.6 if read.any() else 6.8, 4.6), layout="compressed")
    panels = figure.subplots(1, 1 + read.any(), sharex=True, sharey=True, squeeze=False)[0]
    span = np.quantile(np.where(read, speed, true), (0.0, 1.0))
    maps: tuple[tuple[np.ndarray, str, str, dict[str, Any]], ...] = (
        (
            speed,
            "velocity along the line of sight",
            _SPEED,
            {"cmap": "cividis", "vmin": span[0], "vmax": span[1]},
        ),
        (
            normalised,
            "its error over its standard error",
            "normalised error",
            {"cmap": "RdBu_r", "vmin": -4, "vmax": 4},
        ),
    )
    for panel, (values, title, label, style) in zip(panels, maps, strict=False):
        dots = panel.scatter(
            place[read, 1],
            place[read, 2],
            c=values[read],
            s=90,
            edgecolors="0.3",
            linewidths=0.5,
            **style,
        )
        panel.plot(place[~read, 1], place[~read, 2], "kx", ms=6)
        mark_cores(panel, cores, "crimson")
        panel.set(title=title, aspect="equal", xlabel="y / m (port is left)", ylabel="z / m")
        figure.colorbar(dots, ax=panel, label=label, pad=0.02)
    # at least as wide as high, even for lines above each other
    middle, half = (
        (place[:, 1].max() + place[:, 1].min()) / 2,
        np.ptp(place[:, 1:], axis=0).max() / 2,
    )
    # the pilot's view: port, of positive y, is left
    panels[0].set_xlim(middle + half + 4, middle - half - 4)
    return figure, (
        "Middles of the range bins; the velocity includes the motion of the platform. Black "
        f"crosses: lines of sight whose rings gave no velocity.{_crosses(cores, ' Red')}"
    )


def _maps(wind: xr.Dataset, lines: xr.Dataset, cores: Sequence[Core]) -> Captioned:
    figure = Figure(figsize=(17, 10.5), layout="compressed")
    axes = figure.subplots(3, 3, sharex=True, sharey=True)
    valid = wind["flag"] == 0
    y, z = wind["y"], wind["z"]
    place = line_places(lines)
    for row, name in zip(axes, COMPONENTS, strict=True):
        true, value = wind[f"{name}_true"], wind[name].where(valid)
        error = value - true
        values = np.concatenate([true.values.ravel(), value.values.ravel()])
        columns = (
            (true, _colours(values), f"{name}, true"),
            (value, _colours(values), f"{name}, retrieved"),
            (error, _colours(error.values), f"{name}, error"),
        )
        for panel, (field, colours, title) in zip(row, columns, strict=True):
            mesh = coloured(panel, field, **colours)
            panel.set(title=title, aspect="equal")
            figure.colorbar(mesh, ax=panel, label=_SPEED, pad=0.02, extend="both")
            mark_cores(panel, cores, "k", 8)
    # lines of sight where they were used
    axes[0, 1].plot(place[:, 1], place[:, 2], "k.", ms=2)
    # the pilot's view: port, of positive y, is left
    axes[0, 0].set_xlim(float(y.max()), float(y.min()))
    axes[0, 0].set_ylim(float(z.min()), float(z.max()))
    for panel in axes[-1]:
        panel.set_xlabel("y / m (port is left)")
    for panel in axes[:, 0]:
        panel.set_ylabel("z / m")
    return figure, (
        "Rows: u from the lines of sight (dots: their middles), corrected for the cross-flow wind "
        f"of the images; v and w from the images. Valid vectors only.{_crosses(cores, ' Black')}"
    )


def _crosses(cores: Sequence[Core], colour: str) -> str:
    """The part of a caption about the vortices; empty without any."""
    return f"{colour} crosses: true cores." if cores else ""


def _uncertainty(wind: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(17, 4.3), layout="compressed")
    axes = figure.subplots(1, 3, width_ratios=(1.25, 1.25, 1))
    valid = (wind["flag"] == 0).transpose("z", "y").values
    y = wind["y"]
    for panel, name in zip(axes[:2], ("u", "w"), strict=True):
        stderr = wind[f"{name}_stderr"].transpose("z", "y")
        # few large values must not determine the colours
        top = float(np.quantile(stderr.values[valid], 0.99)) if valid.any() else 1.0
        shown = stderr.where(wind["flag"] == 0)
        mesh = coloured(panel, shown, cmap="viridis", vmin=0, vmax=top)
        panel.set(
            title=f"standard error of {name}",
            aspect="equal",
            xlabel="y / m (port is left)",
            ylabel="z / m",
        )
        # the pilot's view, as above
        panel.set_xlim(float(y.max()), float(y.min()))
        figure.colorbar(mesh, ax=panel, label=_SPEED, pad=0.02, extend="max")
    errors = {
        name: (wind[name] - wind[f"{name}_true"]) / wind[f"{name}_stderr"] for name in COMPONENTS
    }
    draw_normalised_errors(
        axes[-1], {name: e.transpose("z", "y").values[valid] for name, e in errors.items()}
    )
    draw_normal_density(axes[-1])
    axes[-1].set_title("errors over standard errors")
    axes[-1].legend()
    return figure, (
        "Left, middle: standard errors of valid vectors. Right: distribution of the errors "
        "against the truth over their standard errors; the last bins hold all beyond."
    )


def _colours(values: np.ndarray) -> dict[str, Any]:
    """Symmetric about 0, or the values' own range if all of them have the same sign."""
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, (0.005, 0.995)) if finite.size else (0.0, 0.0)
    if low > 0 or high < 0:
        return {"cmap": "viridis", "vmin": low, "vmax": high}
    limit = (float(np.quantile(np.abs(finite), 0.995)) if finite.size else 0.0) or 1.0
    return {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
