"""Figures of a coherent lidar: its slices with the vortices, their track, errors by age, winds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import Captioned, Drawn, Progress, save_all
from lidar_mi.assessment.metrics.coherent import PUBLISHED, vortex_errors

_MOST_SLICES = 3  # slices
_MARGIN = 110.0  # m about the vortices
_TRUE, _FOUND = "k", "tab:green"
_SIDES = (("v", "nearer vortex"), ("^", "farther vortex"))


def draw_slices(
    folder: Path, lines: xr.Dataset, vortices: xr.Dataset, log: Progress
) -> list[Drawn]:
    """Figures of vertical slices, from `coherent_lines` and `line_vortices`."""
    figures = [
        ("fig30_slices", "Vertical slices", _slices(lines, vortices)),
        ("fig31_vortex_track", "The vortices by age", _track(vortices)),
    ]
    if (vortices["flag"] == 0).any():
        figures.append(("fig32_vortex_errors", "Errors by age", _errors(vortices)))
    return save_all(folder, figures, log)


def draw_profiles(folder: Path, winds: xr.Dataset, log: Progress) -> list[Drawn]:
    """Figure of winds over height; parameters from `line_winds`."""
    return save_all(folder, [("fig33_winds", "Winds over height", _profiles(winds))], log)


def draw_stare(folder: Path, lines: xr.Dataset, log: Progress) -> list[Drawn]:
    """Figure of lines one after another, by time and range."""
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    seconds = (lines["time"] - lines["time"][0]).values / np.timedelta64(1, "s")
    mesh = axes.pcolormesh(
        seconds, lines["range"], lines["radial_velocity"].T, cmap="RdBu_r", shading="nearest"
    )
    figure.colorbar(mesh, ax=axes, label="radial velocity / (m/s)")
    axes.set(xlabel="time / s", ylabel="range / m")
    plate = figure, "Radial velocity, positive away from the lidar."
    return save_all(folder, [("fig30_lines", "Lines of sight", plate)], log)


def _slices(lines: xr.Dataset, vortices: xr.Dataset) -> Captioned:
    sweeps = np.unique(lines["sweep"])
    usable = np.flatnonzero(vortices["flag"].values == 0)
    usable = usable if usable.size else np.arange(sweeps.size)
    chosen = usable[np.unique(np.linspace(0, usable.size - 1, _MOST_SLICES).round().astype(int))]
    places = vortices.isel(scan=chosen)
    left, right = float(places["y_true"].min()) - _MARGIN, float(places["y_true"].max()) + _MARGIN
    top = float(places["z_true"].max()) + 0.6 * _MARGIN
    # panels are 5.7 inches wide and true to scale
    height = 5.7 * top / (right - left) + 0.5
    figure = Figure(figsize=(13, height * len(chosen) + 0.4), layout="constrained")
    panels = figure.subplots(len(chosen), 2, squeeze=False, sharex=True, sharey=True)
    drawn = lines.isel(time=np.flatnonzero(np.isin(lines["sweep"], sweeps[chosen])))
    limit = float(np.quantile(np.abs(drawn["radial_velocity_true"].values), 0.998))
    for row, number in zip(panels, chosen, strict=True):
        scan = lines.isel(time=np.flatnonzero(lines["sweep"] == sweeps[number]))
        scan = scan.isel(time=np.argsort(scan["elevation"].values))
        pair = vortices.isel(scan=number)
        angle = np.deg2rad(scan["elevation"].values)[:, None]
        y, z = scan["range"].values * np.cos(angle), scan["range"].values * np.sin(angle)
        for axes, name, title in zip(
            row,
            ("radial_velocity", "radial_velocity_true"),
            ("measured", "without noise"),
            strict=True,
        ):
            mesh = axes.pcolormesh(
                y,
                z,
                scan[name],
                cmap="RdBu_r",
                vmin=-limit,
                vmax=limit,
                shading="nearest",
                rasterized=True,
            )
            _mark(axes, pair)
            axes.set_title(f"{title}, age {float(pair['age']):.0f} s")
            axes.set_aspect("equal")
        row[0].set_ylabel("height / m")
    figure.colorbar(mesh, ax=panels, label="radial velocity / (m/s)", pad=0.01, aspect=40)
    for axes in panels[-1]:
        axes.set_xlabel("distance from the lidar / m")
    panels[0, 0].set(xlim=(left, right), ylim=(0, top))
    panels[0, 0].legend(loc="upper left", fontsize=8)
    return figure, (
        "Radial velocity, positive away from the lidar. Black crosses: true vortices; green "
        "circles: fitted vortices with their core and 95 % intervals of the place."
    )


def _mark(axes: Axes, pair: xr.Dataset) -> None:
    axes.plot(pair["y_true"], pair["z_true"], "+", color=_TRUE, ms=9, mew=1.5, label="true")
    if int(pair["flag"]):
        return
    axes.errorbar(
        pair["y"],
        pair["z"],
        xerr=1.96 * pair["y_stderr"].values,
        yerr=1.96 * pair["z_stderr"].values,
        fmt="o",
        mfc="none",
        color=_FOUND,
        ms=7,
        lw=1,
        label="fitted",
    )


def _track(vortices: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    strength, path = figure.subplots(1, 2, width_ratios=(1, 1.4))
    age, valid = vortices["age"].values, (vortices["flag"] == 0).values
    name = "circulation_5_15"
    for k, (marker, side) in enumerate(_SIDES):
        vortex, colour = vortices.isel(vortex=k), f"C{k}"
        sign = np.sign(vortex[f"{name}_true"].values)
        strength.plot(age, sign * vortex[f"{name}_true"], color=colour, lw=1, label=f"{side}, true")
        strength.errorbar(
            age[valid],
            (sign * vortex[name].values)[valid],
            yerr=1.96 * vortex[f"{name}_stderr"].values[valid],
            fmt=marker,
            color=colour,
            ms=4,
            lw=0.8,
            label=f"{side}, fitted",
        )
        path.plot(vortex["y_true"], vortex["z_true"], color=colour, lw=1, label=f"{side}, true")
        fitted = vortex.isel(scan=valid)
        path.errorbar(
            fitted["y"],
            fitted["z"],
            xerr=1.96 * fitted["y_stderr"].values,
            yerr=1.96 * fitted["z_stderr"].values,
            fmt=marker,
            color=colour,
            ms=4,
            lw=0.8,
            label=f"{side}, fitted",
        )
    strength.set(xlabel="age of the wake / s", ylabel="|circulation|, 5 to 15 m / (m²/s)")
    strength.set_ylim(bottom=0)
    strength.legend(fontsize=8)
    path.set(xlabel="distance from the lidar / m", ylabel="height above the lidar / m")
    path.set_ylim(bottom=0)
    return figure, "Every slice by itself, with 95 % intervals; those with a flag are left out."


def _errors(vortices: xr.Dataset) -> Captioned:
    errors = vortex_errors(vortices)
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    panels = figure.subplots(2, 2)
    age, valid = errors["age"].values, (vortices["flag"] == 0).values
    for axes, name, label in (
        (panels[0, 0], "circulation_5_15", "error of the circulation / %"),
        (panels[0, 1], "y", "error of the distance / m"),
        (panels[1, 0], "z", "error of the height / m"),
    ):
        for k, (marker, side) in enumerate(_SIDES):
            vortex, colour = vortices.isel(vortex=k), f"C{k}"
            true = vortex[f"{name}_true"].values
            scale = 100 / np.abs(true) if name == "circulation_5_15" else np.ones_like(true)
            error = scale * (vortex[name].values - true) * np.sign(true)
            axes.errorbar(
                age[valid],
                error[valid],
                yerr=(1.96 * scale * vortex[f"{name}_stderr"].values)[valid],
                fmt=marker,
                color=colour,
                ms=4,
                lw=0.8,
                label=side,
            )
            if f"{name}_tracked" in vortex:
                middle = vortex[f"{name}_tracked"].values - true
                spread = 1.96 * vortex[f"{name}_tracked_stderr"].values
                axes.fill_between(age, middle - spread, middle + spread, color=colour, alpha=0.2)
        axes.axhline(0, color="0.5", lw=0.8)
        axes.set(xlabel="age of the wake / s", ylabel=label)
    panels[0, 0].legend(fontsize=8)
    _normalised(panels[1, 1], errors)
    published = ", ".join(f"{100 * vortex:.0f} %" for vortex in PUBLISHED.values())
    return figure, (
        "Errors of single slices with 95 % intervals; bands: those of the places by all slices "
        "together. Published for simulated scans with known truth, of strength and of place in "
        f"separations: {published}. Last panel: where standard errors hold, curves follow the "
        "dashed one."
    )


def _normalised(axes: Axes, errors: xr.Dataset) -> None:
    """How many errors are below a number of standard errors."""
    from scipy.special import erf

    grid = np.linspace(0, 4, 201)
    for name, text in (("circulation", "circulation"), ("y", "distance"), ("z", "height")):
        values = np.abs(errors[f"{name}_normalised"].values)
        values = np.sort(values[np.isfinite(values)])
        if values.size:
            part = np.searchsorted(values, grid, side="right") / values.size
            axes.plot(grid, 100 * part, drawstyle="steps-post", label=text)
    axes.plot(grid, 100 * erf(grid / np.sqrt(2)), "k--", lw=1, label="normal")
    axes.set(xlabel="size of the error / standard errors", ylabel="errors below it / %")
    axes.legend(fontsize=8)


def _profiles(winds: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(11, 5), layout="constrained")
    panels: Sequence[Axes] = figure.subplots(1, 3, sharey=True)
    height = winds["height"].values
    for axes, name, label in zip(
        panels, "uvw", ("to the east", "to the north", "upwards"), strict=True
    ):
        for k in range(min(winds.sizes["time"], 3)):
            profile = winds.isel(time=k)
            valid = profile["flag"].values == 0
            text = str(profile["time"].values)[11:19]
            axes.plot(profile[f"{name}_true"], height, color=f"C{k}", lw=1, label=f"{text}, true")
            axes.errorbar(
                profile[name].values[valid],
                height[valid],
                xerr=1.96 * profile[f"{name}_stderr"].values[valid],
                fmt=".",
                color=f"C{k}",
                lw=0.8,
                label=f"{text}, retrieved",
            )
        axes.set_xlabel(f"{name}, {label} / (m/s)")
    panels[0].set_ylabel("height above the lidar / m")
    panels[0].legend(fontsize=8)
    return figure, "Valid winds with 95 % intervals, and the means of the true wind over the lines."
