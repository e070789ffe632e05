"""The figures of a run with volumes: the observed volume, the wind, its errors."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lidar_mi.assessment.figures.normalised_errors import (
    draw_normal_density,
    draw_normalised_errors,
)
from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    by_factors,
    coloured,
    mark_cores,
    save_all,
)
from lidar_mi.assessment.labels import BACKSCATTER, METHOD_NAMES
from lidar_mi.atmosphere.vortices.cores import Core

_SPEED = "m s$^{-1}$"
_COMPONENTS = ("u", "v", "w")


def draw_all(
    folder: Path,
    winds: xr.Dataset,
    volumes: Sequence[xr.DataArray],
    cores: Sequence[Core],
    log: Progress,
) -> list[Drawn]:
    """Draw the figures of a run with volumes as PNG into ``folder``.

    Winds are those of `lidar_mi.experiment.stages.volume.volume_winds`; volumes (x, z, y) are
    attenuated backscatter.
    """
    source = winds["source"].values[-1]
    best = winds.sel(source=source).isel(algorithm=-1)
    across = best.isel(x=best.sizes["x"] // 2)
    along = best.sel(z=cores[0].z if cores else 0, method="nearest")
    figures = [("fig30_volume", "The observed volume", _volume_section(volumes, cores))]
    # a cut without a valid vector has nothing to show
    if _any_valid(across):
        title = "The wind in three dimensions"
        figures.append(("fig31_wind_in_three_dimensions", title, _across_x(across, cores)))
    if _any_valid(along):
        figures.append(("fig32_wind_along_x", "The wind along the flight path", _along_x(along)))
    if _any_valid(winds.sel(source=source)):
        errors = _errors(winds.sel(source=source))
        figures.append(("fig33_volume_errors", "Errors of the winds", errors))
    return save_all(folder, figures, log)


def _any_valid(wind: xr.Dataset) -> bool:
    return bool((wind["flag"] == 0).any())


def _volume_section(volumes: Sequence[xr.DataArray], cores: Sequence[Core]) -> Captioned:
    figure = Figure(figsize=(16, 6.4), layout="compressed")
    axes = figure.subplots(2, 2, height_ratios=(3.2, 1))
    values = [1e6 * volume for volume in volumes]
    limits = [float(values[0].quantile(q)) for q in (0.01, 0.995)]
    z = float(values[0]["z"].sel(z=cores[0].z if cores else 0, method="nearest"))
    for column, (volume, when) in enumerate(zip(values, ("first", "second"), strict=True)):
        middle = volume.isel(x=volume.sizes["x"] // 2)
        mesh = _map(axes[0, column], middle, "y", "z", "viridis", *limits)
        axes[0, column].set_title(f"{when} scan, x = {float(middle['x']):.2f} m")
        _map(axes[1, column], volume.sel(z=z), "y", "x", "viridis", *limits)
        axes[1, column].set_title(f"{when} scan, z = {z:.1f} m")
        figure.colorbar(mesh, ax=axes[:, column], label=BACKSCATTER, pad=0.02, extend="both")
    return figure, (
        "Top: one of the gates, in the pilot's view. Bottom: a cut through all gates from above "
        "at the height of a vortex, the flight path upwards."
    )


def _across_x(cut: xr.Dataset, cores: Sequence[Core]) -> Captioned:
    figure = Figure(figsize=(17, 10.5), layout="compressed")
    axes = figure.subplots(3, 3, sharex=True, sharey=True)
    for row, name in zip(axes, _COMPONENTS, strict=True):
        _row(row, cut, name, "y", "z")
        for panel in row:
            mark_cores(panel, cores, "k", 8)
    for panel in axes[:-1].ravel():
        panel.set_xlabel("")
    return figure, (
        f"A cut across the flight path at x = {float(cut['x']):.2f} m, by the last method of the "
        "experiment. Valid vectors only; crosses: true cores. The errors have their own scales."
    )


def _along_x(cut: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(17, 5.4), layout="compressed")
    axes = figure.subplots(3, 3, sharex=True, sharey=True)
    for row, name in zip(axes, _COMPONENTS, strict=True):
        _row(row, cut, name, "y", "x", stretch=2)
    for panel in axes[:-1].ravel():
        panel.set_xlabel("")
    return figure, (
        f"The same from above, at z = {float(cut['z']):.1f} m, the height of a vortex, x twice as "
        "large as y, which no single slab shows."
    )


def _row(
    panels: np.ndarray, cut: xr.Dataset, name: str, across: str, up: str, stretch: float = 1
) -> None:
    true, value = cut[f"{name}_true"], cut[name].where(cut["flag"] == 0)
    error = value - true
    limit, small = _limit(true), _limit(error)
    for panel, field, bound, title in (
        (panels[0], true, limit, f"{name}, true"),
        (panels[1], value, limit, f"{name}, retrieved"),
        (panels[2], error, small, f"{name}, error"),
    ):
        mesh = _map(panel, field, across, up, "RdBu_r", -bound, bound)
        panel.set(title=title, aspect=stretch)
        bar = panel.figure.colorbar(mesh, ax=panel, label=_SPEED, pad=0.02, extend="both")
        # few ticks beside low panels
        bar.locator = MaxNLocator(7 if stretch == 1 else 3)


def _map(
    panel: Axes, field: xr.DataArray, across: str, up: str, colours: str, low: float, high: float
) -> QuadMesh:
    mesh = coloured(panel, field, across, up, cmap=colours, vmin=low, vmax=high)
    half = float(field[across][1] - field[across][0]) / 2
    panel.set(aspect="equal", xlabel=f"{across} / m (port is left)", ylabel=f"{up} / m")
    panel.set_xlim(float(field[across].max()) + half, float(field[across].min()) - half)
    return mesh


def _errors(winds: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(17, 8.4), layout="compressed")
    axes = figure.subplots(2, 3)
    # an experiment may have a single method
    colours = dict(zip(winds["algorithm"].values, ("tab:orange", "tab:blue"), strict=False))
    for column, name in enumerate(_COMPONENTS):
        profile, density = axes[:, column]
        rms = np.sqrt((winds[f"{name}_true"] ** 2).mean(("y", "z")))
        profile.plot(winds["x"], rms, "k:", label="the wind itself, rms")
        for method, colour in colours.items():
            wind = winds.sel(algorithm=method)
            valid = wind["flag"] == 0
            error = (wind[name] - wind[f"{name}_true"]).where(valid)
            stderr = wind[f"{name}_stderr"].where(valid)
            for values, style, text in ((error, "-", "error"), (stderr, "--", "as stated")):
                level = np.sqrt((values**2).mean(("y", "z")))
                profile.plot(
                    winds["x"], level, style, color=colour, label=f"{METHOD_NAMES[method]}, {text}"
                )
            normalised = (error / stderr).values
            draw_normalised_errors(density, {METHOD_NAMES[method]: normalised}, color=colour)
        profile.set(title=f"rms error of {name}", xlabel="x / m", ylabel=_SPEED)
        by_factors(profile)
        draw_normal_density(density)
        density.set_title(f"errors of {name} over standard errors")
    # between the errors and the wind, which is large for v and w
    axes[0, 1].legend(fontsize="small", loc="center")
    axes[1, 0].legend(fontsize="small")
    return figure, (
        "Top: rms errors of valid vectors against the truth, gate by gate, the standard errors "
        "stated by the methods, and the rms of the wind itself: an error above that line means "
        "no skill. Bottom: errors over standard errors; the last bins hold all beyond."
    )


def _limit(values: xr.DataArray) -> float:
    sizes = np.abs(values.values[np.isfinite(values.values)])
    return (float(np.quantile(sizes, 0.995)) if sizes.size else 0.0) or 1.0
