"""Figures of a flight into a wake: the approach, the track, the moments, the rolling."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lidar_mi.assessment.figures.alt_text import TRUE_CORE
from lidar_mi.assessment.figures.encounter_loads import load_factor
from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    arrow_scale,
    coloured,
    pilots_view,
    save_all,
)
from lidar_mi.assessment.metrics.encounter import CONTROLLER, MET, flight_name
from lidar_mi.assessment.metrics.encounter_hazard import ACCEPTED_BANK

FLIGHTS = {
    mode: (flight_name(mode), *style)
    for mode, style in {
        "off": ("tab:red", "-"),
        "autopilot": ("tab:purple", ":"),
        "feedforward": ("tab:blue", "-"),
        "perfect": ("0.35", "--"),
    }.items()
}
"""Names, colours and lines of the flights."""

SIDES = {"port": "#c2571a", "starboard": "#2c7a3f"}
TWO_SIGMA = 2.0

_ROWS = (
    ("circulation", "circulation / m$^2$ s$^{-1}$"),
    ("core_radius", "core radius / m"),
    ("y", "y - true y / m"),
    ("z", "z - true z / m"),
)


def draw_all(
    folder: Path,
    series: xr.Dataset,
    track: xr.Dataset | None,
    slabs: xr.Dataset | None,
    span: float,
    log: Progress,
) -> list[Drawn]:
    """Draw all figures of a flight of an aircraft of this span (m).

    The series has dims (flight, time), the track (source, slab); slabs are images and vectors.
    """
    figures = [("fig30_roll", "Roll angle and roll rate", _roll(series))]
    if track is not None and track.sizes["slab"]:
        if slabs is not None:
            overview = _overview(series, track, slabs, span)
            figures.insert(0, ("fig29_encounter", "A slab ahead, and the roll angle", overview))
        figures.append(
            (
                "fig31_approach",
                "The approach from above and from the side",
                _approach(series, track, slabs),
            )
        )
        if slabs is not None:
            figures.append(
                ("fig32_cockpit", "A slab from the cockpit", _cockpit(track, slabs, span))
            )
        if np.isfinite(track["port_y"].values).any():
            figures.append(("fig33_track", "The vortices, estimated and tracked", _track(track)))
    if "feedforward" in series["flight"]:
        figures.append(("fig34_moment", "Predicted and true rolling moment", _moment(series)))
    figures.append(("fig35_commands", "The ailerons", _commands(series)))
    if series.attrs.get(MET) == "air":
        figures.append(("fig36_loads", "Loads by the wind", _loads(series)))
    if np.isfinite(series["load_factor"]).any():
        figures.append(
            ("fig37_load_factor", "Load factor and bending", load_factor(series, _lines))
        )
    return save_all(folder, figures, log)


def flight_style(mode: str, series: xr.Dataset) -> tuple[str, str, str]:
    """Name, colour and line of a flight, with the name of a controller of one's own."""
    return (flight_name(mode, series.attrs.get(CONTROLLER, "")), *FLIGHTS[mode][1:])


def _flown(series: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Flights in the order in which they are drawn, the one with the lidar on top."""
    modes = [str(mode) for mode in series["flight"].values]
    return [
        (mode, series.sel(flight=mode))
        for mode in ("off", "autopilot", "perfect", "feedforward")
        if mode in modes
    ]


def _lines(axes: Axes, series: xr.Dataset, name: str, factor: float = 1.0) -> None:
    for mode, flight in _flown(series):
        label, colour, style = flight_style(mode, series)
        axes.plot(
            flight["time"], factor * flight[name], color=colour, ls=style, lw=1.8, label=label
        )
    axes.grid(alpha=0.3)


def _roll(series: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(10.5, 6.4), layout="compressed")
    angle, rate = figure.subplots(2, 1, sharex=True)
    _lines(angle, series, "roll", np.degrees(1))
    _lines(rate, series, "roll_rate", np.degrees(1))
    limit = np.degrees(ACCEPTED_BANK)
    angle.axhspan(-limit, limit, color="0.5", alpha=0.12, lw=0, label=f"below {limit:.0f} degrees")
    angle.set_ylabel("roll angle / degrees")
    rate.set(ylabel="roll rate / degrees s$^{-1}$", xlabel="time of flight / s")
    angle.legend(fontsize=9, loc="best")
    return (figure, "Positive: port wing up. Shaded: bank angles of a stable approach.")


def _approach(series: xr.Dataset, track: xr.Dataset, slabs: xr.Dataset | None) -> Captioned:
    figure = Figure(figsize=(11.5, 7.2), layout="compressed")
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    flight = series.sel(flight="feedforward")
    truth, tracked, estimate = (track.sel(source=s) for s in ("truth", "track", "estimate"))
    for axes, axis in ((above, "y"), (side, "z")):
        for name, colour in SIDES.items():
            key = f"{name}_{axis}"
            axes.plot(
                track["x"],
                truth[key],
                color="k",
                lw=1.2,
                # one entry in the legend for both
                label="true vortices" if name == "port" else None,
            )
            axes.errorbar(
                track["x"],
                estimate[key],
                TWO_SIGMA * estimate[f"{key}_stderr"],
                fmt=".",
                ms=4,
                color="0.55",
                elinewidth=0.8,
                label="estimate of each slab, 2 sigma" if name == "port" else None,
            )
            axes.plot(track["x"], tracked[key], color=colour, lw=2, label=f"{name}, tracked")
        axes.plot(flight["x"], flight[axis], color="tab:blue", lw=2, label="flight path")
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    if slabs is not None and "image_y" in slabs:
        low, high = float(slabs["image_y"].min()), float(slabs["image_y"].max())
        above.vlines(
            track["x"],
            low,
            high,
            color="tab:cyan",
            lw=0.7,
            alpha=0.5,
            zorder=0,
            label="measured slabs",
        )
    above.set_ylabel("y / m (port is up)")
    side.set(ylabel="z / m", xlabel="x along the path / m")
    above.legend(fontsize=8, ncols=3, loc="best")
    return figure, (
        "Each slab is measured twice. Vortices are shown in its plane at the time of measurement. "
        "The path frame is inclined as the path, so that a level wake rises along it on a descent."
    )


def _overview(series: xr.Dataset, track: xr.Dataset, slabs: xr.Dataset, span: float) -> Captioned:
    figure = Figure(figsize=(13.6, 4.9), layout="compressed")
    view, angle = figure.subplots(1, 2, width_ratios=(1.25, 1))
    ahead = _draw_slab(view, track, slabs, span)
    view.set_title(f"backscatter and wind of a slab, {ahead:.1f} s ahead", loc="left")
    view.legend(loc="lower center", ncols=3, fontsize=8)
    _lines(angle, series, "roll", np.degrees(1))
    angle.set(title="roll angle", ylabel="degrees", xlabel="time of flight / s")
    angle.legend(fontsize=9)
    return figure, (
        "A slab from the cockpit, with the cores of its vortices, and the roll angles on the "
        "same flight path through the same wake."
    )


def _cockpit(track: xr.Dataset, slabs: xr.Dataset, span: float) -> Captioned:
    figure = Figure(figsize=(10.5, 7.0), layout="compressed")
    axes = figure.subplots()
    ahead = _draw_slab(axes, track, slabs, span)
    axes.legend(loc="lower center", ncols=3, fontsize=9)
    view = slabs.isel(slab=best_slab(track, slabs))
    return figure, (
        f"Backscatter of the slab at x = {float(view['x']):.0f} m with the wind retrieved from "
        f"both images, delivered {ahead:.1f} s before the wing is there. Circles: cores with the "
        "radius of their largest swirl."
    )


def _draw_slab(axes: Axes, track: xr.Dataset, slabs: xr.Dataset, span: float) -> float:
    """Image, wind, vortices and wing; time from the delivery to the wing's arrival, s."""
    view = slabs.isel(slab=best_slab(track, slabs))
    draw_image(axes, view)
    draw_vectors(axes, view)
    number = int(np.argmin(np.abs(track["x"].values - float(view["x"]))))
    draw_vortices(axes, track.isel(slab=number))
    axes.plot(
        [-span / 2, span / 2],
        [0, 0],
        color="tab:blue",
        lw=4,
        solid_capstyle="round",
        label="wing, where it will pass",
    )
    axes.set(xlabel="y / m (port is left)", ylabel="z / m")
    # places and times are from the start of the path
    speed = float(np.gradient(track["x"], track["time"]).mean())
    return float(view["x"]) / speed - float(view["delivered"])


def best_slab(track: xr.Dataset, slabs: xr.Dataset) -> int:
    """The last slab whose vortices were found on both sides of the path; else the last accepted."""
    estimate = track.sel(source="estimate")
    astride = (estimate["port_y"] > 0) & (estimate["starboard_y"] < 0)
    for chosen in (astride, track["accepted"] > 0):
        x = track["x"].values[chosen.values]
        if x.size:
            middle = x[x.size // 2]
            return int(np.argmin(np.abs(slabs["x"].values - middle)))
    return slabs.sizes["slab"] - 1


def draw_image(axes: Axes, view: xr.Dataset, limits: tuple[float, float] | None = None) -> None:
    """Backscatter of a slab in the pilot's view."""
    if "image" not in view:
        return
    low, high = limits or np.nanquantile(view["image"], (0.01, 0.995))
    coloured(axes, view["image"], "image_y", "image_z", cmap="gray", vmin=low, vmax=high)
    pilots_view(axes, view["image_y"], view["image_z"])


def draw_vectors(axes: Axes, view: xr.Dataset) -> None:
    """Wind vectors of a slab, those that are valid."""
    if "v" not in view:
        return
    y, z = np.meshgrid(view["y"], view["z"])
    step = float(view["y"][1] - view["y"][0])
    # 10 m/s is as long as the vectors are apart
    arrows = axes.quiver(
        y,
        z,
        view["v"],
        view["w"],
        color="#f2c14e",
        angles="xy",
        scale_units="xy",
        scale=10 / step,
        width=0.0022,
    )
    arrow_scale(axes, arrows, 10.0)


def draw_vortices(axes: Axes, at: xr.Dataset) -> None:
    """Cores of a slab: true, and as tracked."""
    for side in SIDES:
        label = side == "port"
        truth, track = (at.sel(source=source) for source in ("truth", "track"))
        axes.plot(
            truth[f"{side}_y"],
            truth[f"{side}_z"],
            "+",
            color="cyan",
            ms=12,
            mew=1.6,
            label="true cores" if label else f"_{TRUE_CORE}",
            ls="none",
        )
        y, z, radius = (float(track[f"{side}_{name}"]) for name in ("y", "z", "core_radius"))
        if np.isfinite([y, z, radius]).all():
            circle = Circle(
                (y, z),
                radius,
                fill=False,
                ec="tab:orange",
                lw=2.2,
                label="tracked" if label else None,
            )
            axes.add_patch(circle)


def _track(track: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(11.5, 10.0), layout="compressed")
    panels = figure.subplots(len(_ROWS), 2, sharex=True)
    truth, tracked, estimate = (track.sel(source=s) for s in ("truth", "track", "estimate"))
    x = track["x"].values
    for row, (name, label) in zip(panels, _ROWS, strict=True):
        for axes, (side, colour) in zip(row, SIDES.items(), strict=True):
            key = f"{side}_{name}"
            # along the path, places change by far more than their errors
            zero = truth[key].values if name in "yz" else 0.0
            spread = TWO_SIGMA * tracked[f"{key}_stderr"].values
            middle, single = tracked[key].values - zero, estimate[key].values - zero
            true = truth[key].values - zero
            bars = TWO_SIGMA * estimate[f"{key}_stderr"].values
            axes.errorbar(
                x,
                single,
                bars,
                fmt=".",
                ms=4,
                color="0.6",
                elinewidth=0.8,
                label="estimates, 2 sigma",
            )
            axes.fill_between(
                x,
                middle - spread,
                middle + spread,
                color=colour,
                alpha=0.3,
                lw=0,
                label="track, 2 sigma",
            )
            axes.plot(x, middle, color=colour, lw=1.6)
            axes.plot(x, true, color="k", lw=1.2, label="truth")
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            _fit_limits(axes, true, single, spread)
    for axes, side in zip(panels[0], SIDES, strict=True):
        axes.set_title(f"{side} vortex")
    for axes in panels[-1]:
        axes.set_xlabel("x of the slab / m")
    panels[0, 0].legend(fontsize=8, loc="best")
    return figure, (
        "Parameters in the plane of every slab at its time of measurement: estimates of single "
        "slabs, the track after each of them, the truth. An estimate is missing where its fit was "
        "not accepted, mostly where a vortex is outside the image."
    )


def _fit_limits(axes: Axes, truth: np.ndarray, estimates: np.ndarray, spread: np.ndarray) -> None:
    """Values of truth and estimates, without the widest bands."""
    inside = np.isfinite(estimates)
    values = np.concatenate([truth[inside], estimates[inside]]) if inside.any() else truth
    # the band of a track that begins is many times as wide as later
    band = float(np.nanmedian(spread)) if np.isfinite(spread).any() else 0.0
    margin = max(0.3 * float(np.ptp(values)), 2 * band, 0.05)
    if np.isfinite([values.min(), values.max(), margin]).all():
        axes.set_ylim(values.min() - margin, values.max() + margin)


def _moment(series: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(10.5, 6.4), layout="compressed")
    moment, difference = figure.subplots(2, 1, sharex=True)
    flight = series.sel(flight="feedforward")
    moment.plot(flight["time"], 1e-3 * flight["roll_moment"], color="k", lw=1.8, label="true")
    moment.plot(
        flight["time"],
        1e-3 * flight["predicted_roll_moment"],
        color="tab:blue",
        lw=1.8,
        ls="--",
        label="predicted from the track",
    )
    moment.plot(
        flight["time"],
        # ailerons that cancel the wake's moment lie on its curve
        -1e-3 * flight["control_roll_moment"],
        color="tab:orange",
        lw=1.2,
        label="of the ailerons, reversed",
    )
    difference.plot(
        flight["time"],
        1e-3 * (flight["predicted_roll_moment"] - flight["roll_moment"]),
        color="tab:blue",
        lw=1.5,
        label="predicted - true",
    )
    difference.plot(
        flight["time"],
        1e-3 * (flight["roll_moment"] + flight["control_roll_moment"]),
        color="tab:orange",
        lw=1.5,
        label="felt: wake and ailerons",
    )
    for axes in (moment, difference):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=9, loc="best")
        axes.set_ylabel("rolling moment / kN m")
    difference.set_xlabel("time of flight / s")
    return figure, (
        "Flight with the lidar. Predicted: the moment on this wing from the track alone, of slabs "
        "measured up to two seconds before."
    )


def _commands(series: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(10.5, 4.0), layout="compressed")
    axes = figure.subplots()
    _lines(axes, series, "aileron_deflection", np.degrees(1))
    axes.set(ylabel="aileron / degrees", xlabel="time of flight / s")
    axes.legend(fontsize=9)
    return figure, "Deflections, within the limits and the rate of the actuators."


def _loads(series: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(10.5, 6.4), layout="compressed")
    force, moment = figure.subplots(2, 1, sharex=True)
    _lines(force, series, "force_z", 1e-3)
    _lines(moment, series, "roll_moment", 1e-3)
    largest = 1e-3 * float(series["largest_control_roll_moment"].max())
    moment.axhspan(-largest, largest, color="0.5", alpha=0.12, lw=0, label="within the ailerons'")
    force.set_ylabel("vertical force / kN")
    moment.set(ylabel="rolling moment / kN m", xlabel="time of flight / s")
    moment.legend(fontsize=9, loc="best")
    return figure, (
        "Force and moment by the wind on wing and tail, without those by the aircraft's own "
        "motion. Shaded: moments within those of the ailerons at full deflection."
    )
