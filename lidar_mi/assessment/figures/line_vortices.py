"""Figure of vortices from scans of a Doppler lidar: the scan, and the track over scans."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_COLOURS = ("tab:blue", "tab:red")
_MARGIN = 70.0  # m of the scan that is drawn around the vortices


def draw_line_vortices(lines: xr.Dataset, vortices: xr.Dataset, title: str = "") -> Figure:
    """The scan that shows most, with its vortices; of several with valid ones, their course too.

    Lines are those of `read_lines_of_sight`, vortices those of `fit_vortices_to_lines`.
    """
    # without a valid fit there is nothing to follow
    several = vortices.sizes["scan"] > 1 and bool((vortices["flag"] == 0).any())
    figure = Figure(figsize=(11, 9 if several else 5), layout="constrained")
    if title:
        figure.suptitle(title)
    ratios = (2, 1, 1) if several else (1,)
    first, *others = figure.subplots(len(ratios), 1, height_ratios=ratios, squeeze=False)[:, 0]
    # of scans without a valid fit, the one that is most like a wake
    score = np.where(vortices["flag"] == 0, 1e6, 0.0) + vortices["score"].values
    _scan(figure, first, lines, vortices, int(np.argmax(score)))
    if others:
        _over_time(others[0], vortices, "y", "horizontal distance / m")
        _over_time(others[1], vortices, "circulation", "circulation / (m²/s)")
        others[1].set_xlabel("time (UTC)")
    return figure


def _scan(figure: Figure, axes: Axes, lines: xr.Dataset, vortices: xr.Dataset, scan: int) -> None:
    pair = vortices.isel(scan=scan)
    within = (lines["time"] >= pair["start"].values) & (lines["time"] <= pair["end"].values)
    part = lines.isel(time=np.flatnonzero(within))
    elevation = np.deg2rad(part["elevation"].values)
    azimuth = np.deg2rad(part["azimuth"].values - float(pair["azimuth"]))
    angle = np.arctan2(np.sin(elevation), np.cos(elevation) * np.cos(azimuth))
    order = np.argsort(angle)
    distance = part["range"].values
    y, z = distance * np.cos(angle[order, None]), distance * np.sin(angle[order, None])
    speed = part["radial_velocity"].where(part["flag"] == 0).values[order]
    middle = float(np.nanmedian(speed))
    largest = max(float(np.nanpercentile(np.abs(speed - middle), 99.5)), 0.1)
    drawn = axes.pcolormesh(
        y,
        z,
        np.ma.masked_invalid(speed - middle),
        shading="nearest",
        cmap="RdBu_r",
        vmin=-largest,
        vmax=largest,
        rasterized=True,
    )
    figure.colorbar(drawn, ax=axes, label=f"radial velocity less {middle:.1f} m/s / (m/s)")
    for k, colour in zip(range(vortices.sizes["vortex"]), _COLOURS, strict=False):
        place = float(pair["y"][k]), float(pair["z"][k])
        if not np.isfinite(place).all():
            continue
        error = [1.96 * float(pair[f"{name}_stderr"][k]) for name in "yz"]
        label = f"{float(pair['circulation'][k]):.0f} m²/s"
        axes.errorbar(
            *place, yerr=error[1], xerr=error[0], fmt="+", ms=12, c=colour, label=label, mew=1.5
        )
    if np.isfinite(pair["y"].values).all():
        axes.set_xlim(float(pair["y"].min()) - _MARGIN, float(pair["y"].max()) + _MARGIN)
        axes.set_ylim(
            max(float(pair["z"].min()) - _MARGIN, float(z.min())), float(pair["z"].max()) + _MARGIN
        )
        axes.legend(loc="upper right", title="circulation, 95 % of place")
    time = str(pair["time"].values)[:19].replace("T", " ")
    verdict = "" if int(pair["flag"]) == 0 else ", not valid"
    axes.set(aspect="equal", xlabel="horizontal distance / m", ylabel="height above the lidar / m")
    axes.set_title(f"{time} UTC{verdict}", fontsize="medium")


def _over_time(axes: Axes, vortices: xr.Dataset, name: str, label: str) -> None:
    """Valid fits with 95 % intervals, and the track as a band."""
    valid = (vortices["flag"] == 0).values
    time = vortices["time"].values
    for k, colour in zip(range(vortices.sizes["vortex"]), _COLOURS, strict=False):
        value = vortices[name].values[:, k]
        error = 1.96 * vortices[f"{name}_stderr"].values[:, k]
        axes.errorbar(time[valid], value[valid], yerr=error[valid], fmt=".", c=colour, lw=0.8)
        if f"{name}_tracked" in vortices:
            middle = vortices[f"{name}_tracked"].values[:, k]
            half = 1.96 * vortices[f"{name}_tracked_stderr"].values[:, k]
            axes.fill_between(time, middle - half, middle + half, color=colour, alpha=0.25, lw=0)
    axes.set_ylabel(label)
