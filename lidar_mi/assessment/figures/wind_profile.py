"""Figures of wind profiles: speed, direction and vertical wind over height."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import coloured

_MOST_CURVES = 6


def draw_wind_profiles(winds: xr.Dataset, title: str = "") -> Figure:
    """Valid winds over height: of up to six profiles as points with 95 % intervals, else as maps.

    Winds are those of `fit_winds_to_lines`.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    if title:
        figure.suptitle(title)
    valid = winds.where(winds["flag"] == 0)
    measured = np.isfinite(valid["u"].values).any(0)
    # heights above the last that has a wind say nothing
    valid = valid.isel(height=slice(0, int(np.flatnonzero(measured).max(initial=0)) + 1))
    if winds.sizes["time"] <= _MOST_CURVES:
        _curves(figure, valid)
    else:
        _maps(figure, valid)
    return figure


def _curves(figure: Figure, valid: xr.Dataset) -> None:
    speed, direction, vertical = figure.subplots(1, 3, sharey=True)
    height = valid["height"].values
    for k in range(valid.sizes["time"]):
        profile = valid.isel(time=k)
        label = str(profile["time"].values)[:19].replace("T", " ")
        size = np.maximum(profile["wind_speed"].values, 1e-6)
        along, across = _errors(profile)
        style = {"fmt": ".", "ms": 4, "lw": 0.7, "label": label}
        speed.errorbar(profile["wind_speed"], height, xerr=1.96 * along, **style)
        degrees = np.minimum(np.rad2deg(1.96 * across / size), 180)
        direction.errorbar(profile["wind_from_direction"], height, xerr=degrees, **style)
        vertical.errorbar(profile["w"], height, xerr=1.96 * profile["w_stderr"].values, **style)
    speed.set(xlabel="wind speed / (m/s)", ylabel="height above the lidar / m")
    direction.set(xlabel="wind from / degrees", xlim=(0, 360), xticks=range(0, 361, 90))
    vertical.set(xlabel="vertical wind / (m/s)")
    vertical.axvline(0, color="0.7", lw=0.8)
    speed.legend(fontsize="small")


def _errors(profile: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors of the horizontal wind along and across its direction, m/s."""
    size = np.maximum(profile["wind_speed"].values, 1e-6)
    east, north = profile["u"].values / size, profile["v"].values / size
    uu, vv = profile["u_stderr"].values ** 2, profile["v_stderr"].values ** 2
    uv = profile["uv_correlation"].values * profile["u_stderr"].values * profile["v_stderr"].values
    along = east**2 * uu + 2 * east * north * uv + north**2 * vv
    across = north**2 * uu - 2 * east * north * uv + east**2 * vv
    return np.sqrt(along), np.sqrt(across)


def _maps(figure: Figure, valid: xr.Dataset) -> None:
    panels = figure.subplots(3, 1, sharex=True, sharey=True)
    largest = float(np.nanmax(np.abs(valid["w"].values), initial=0.1))
    options: dict[str, Any]
    for axes, (name, label, options) in zip(
        panels,
        (
            ("wind_speed", "wind speed / (m/s)", {"cmap": "viridis", "vmin": 0}),
            (
                "wind_from_direction",
                "wind from / degrees",
                {"cmap": "twilight", "vmin": 0, "vmax": 360},
            ),
            ("w", "vertical wind / (m/s)", {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}),
        ),
        strict=True,
    ):
        drawn = coloured(axes, valid[name], "time", "height", **options)
        figure.colorbar(drawn, ax=axes, label=label)
        axes.set_ylabel("height / m")
    panels[-1].set_xlabel("time (UTC)")
