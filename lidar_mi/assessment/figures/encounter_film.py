"""The flight as a film: the slab seen now, the wings now, and where the aircraft is."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.encounter import SIDES, draw_image, draw_vortices, flight_style

MOST_FRAMES = 40
_SIZE, _DOTS = (7.2, 8.0), 90


class Frame(NamedTuple):
    """A frame (height, width, 3), 8 bit, and what it shows."""

    pixels: np.ndarray
    caption: str
    time: float


def film(
    series: xr.Dataset, track: xr.Dataset | None, slabs: xr.Dataset | None, span: float
) -> Iterator[Frame]:
    """Frames from the first slab to the end of the flight; none without images.

    Parameters
    ----------
    series, track, slabs : xr.Dataset
        As of `lidar_mi.assessment.figures.encounter.draw_all`.
    span : float
        Of the aircraft, m.
    """
    if track is None or slabs is None or "image" not in slabs:
        return
    times = series["time"].values
    start = float(slabs["delivered"].min())
    low, high = (float(q) for q in np.nanquantile(slabs["image"], (0.01, 0.995)))
    for time in np.linspace(start, float(times[-1]), MOST_FRAMES):
        yield _frame(series, track, slabs, span, float(time), (low, high))


def _frame(
    series: xr.Dataset,
    track: xr.Dataset,
    slabs: xr.Dataset,
    span: float,
    time: float,
    limits: tuple[float, float],
) -> Frame:
    figure = Figure(figsize=_SIZE, dpi=_DOTS, layout="constrained")
    view, above, roll = figure.subplots(3, 1, height_ratios=(4.4, 1.5, 1.3))
    number = int(np.flatnonzero(slabs["delivered"].values <= time)[-1])
    slab = slabs.isel(slab=number)
    at = track.isel(slab=int(np.argmin(np.abs(track["x"].values - float(slab["x"])))))
    one = series.sel(flight="feedforward").sel(time=time, method="nearest")
    draw_image(view, slab, limits)
    draw_vortices(view, at)
    wings = {
        str(mode): float(series["roll"].sel(flight=mode).sel(time=time, method="nearest"))
        for mode in ("off", "feedforward")
    }
    for mode, angle in wings.items():
        label, colour, _ = flight_style(mode, series)
        # rolled with the port wing, which is on the left, up
        ends = np.array([-1, 1]) * span / 2
        view.plot(
            ends * np.cos(angle),
            ends * np.sin(angle),
            color=colour,
            lw=3,
            solid_capstyle="round",
            label=label,
        )
    view.set(xlabel="y / m (port is left)", ylabel="z / m")
    view.set_title(f"slab {float(slab['x']) - float(one['x']):.0f} m ahead", fontsize=10)
    _from_above(above, series, track, slabs, slab, one, time)
    _rolled(roll, series, time)
    figure.align_ylabels([above, roll])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    words = ", ".join(
        f"{flight_style(mode, series)[0]} {np.degrees(a):+.1f}°" for mode, a in wings.items()
    )
    return Frame(pixels, f"{time:.1f} s: roll angle {words}", time)


def _from_above(
    axes: Axes,
    series: xr.Dataset,
    track: xr.Dataset,
    slabs: xr.Dataset,
    slab: xr.Dataset,
    one: xr.Dataset,
    time: float,
) -> None:
    known = track["delivered"].values <= time
    for side, colour in SIDES.items():
        axes.plot(track["x"], track[f"{side}_y"].sel(source="truth"), color="k", lw=0.9)
        axes.plot(
            track["x"][known], track[f"{side}_y"].sel(source="track")[known], color=colour, lw=2
        )
    x, y = float(one["x"]), float(one["y"])
    low, high = float(slabs["image_y"].min()), float(slabs["image_y"].max())
    axes.fill(
        [x, float(slab["x"]), float(slab["x"])], [y, low, high], color="tab:cyan", alpha=0.25, lw=0
    )
    axes.plot(x, y, marker=">", color="tab:blue", ms=9)
    axes.set(xlabel="x along the path / m", ylabel="y / m")
    axes.set_xlim(0, float(series["x"].max()))
    axes.set_ylim(1.6 * low, 1.6 * high)
    axes.grid(alpha=0.3)


def _rolled(axes: Axes, series: xr.Dataset, time: float) -> None:
    for mode in series["flight"].values:
        label, colour, style = flight_style(str(mode), series)
        one = series.sel(flight=mode)
        done = one["time"].values <= time
        axes.plot(
            one["time"][done],
            np.degrees(one["roll"][done]),
            color=colour,
            ls=style,
            lw=1.6,
            label=label,
        )
    largest = float(np.degrees(np.abs(series["roll"]).max())) * 1.1 or 1.0
    axes.set(xlabel="time of flight / s", ylabel="roll / degrees")
    axes.set_xlim(0, float(series["time"].max()))
    # the legend is above the curves
    axes.set_ylim(-largest, 2 * largest)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="upper left", ncols=3)
