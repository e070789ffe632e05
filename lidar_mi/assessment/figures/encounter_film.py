"""The flight as a film in real time: the last slab delivered, the wings, where the aircraft is.

States are interpolated from frame to frame. The background is drawn once, moving parts on top of
it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnchoredText
from matplotlib.patheffects import AbstractPathEffect, withStroke
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

from lidar_mi.assessment.figures.encounter import SIDES, draw_image, draw_vortices, flight_style

RATE = 25
"""Frames per second of flight and of film."""

SCALE_LENGTH, SCALE_SPEED = 20.0, 10.0
"""Scales in the film: a length in m, a wind in m/s."""

_SIZE, _DOTS = (7.2, 8.0), 90  # even numbers of pixels, as video codecs expect
_WINGS = ("off", "feedforward")
_EDGE: list[AbstractPathEffect] = [withStroke(linewidth=2.5, foreground="black")]
"""Edge of white words, visible also on bright backscatter."""


class Frame(NamedTuple):
    """A frame (height, width, 3), 8 bit, and what it shows."""

    pixels: np.ndarray
    caption: str
    time: float


def frame_times(
    series: xr.Dataset, track: xr.Dataset | None, slabs: xr.Dataset | None
) -> list[float]:
    """Times (s) of the frames of `film`, `RATE` a second; none without images."""
    if track is None or slabs is None or "image" not in slabs:
        return []
    start, end = float(slabs["delivered"].min()), float(series["time"].max())
    return [start + k / RATE for k in range(int((end - start) * RATE + 1e-6) + 1)]


def film(
    series: xr.Dataset, track: xr.Dataset | None, slabs: xr.Dataset | None, span: float
) -> Iterator[Frame]:
    """Frames from the first slab delivered to the end of the flight; none without images.

    Arguments are those of `lidar_mi.assessment.figures.encounter.draw_all`.
    """
    times = frame_times(series, track, slabs)
    if track is None or slabs is None or not times:
        return
    flights = series[["x", "y", "z", "roll"]].interp(time=times)
    states = {
        str(mode): {str(name): values.values for name, values in flights.sel(flight=mode).items()}
        for mode in flights["flight"].values
    }
    limits = tuple(float(q) for q in np.nanquantile(slabs["image"], (0.01, 0.995)))
    figure = Figure(figsize=_SIZE, dpi=_DOTS, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    view, above, roll = figure.subplots(3, 1, height_ratios=(4.4, 1.5, 1.3))
    moving: list[_Wings | _FromAbove | _Rolled] = [
        _Wings(view, series, states, span),
        _FromAbove(above, series, track, slabs, states),
        _Rolled(roll, series),
    ]
    slab_view = _SlabView(view, track, slabs, states, (limits[0], limits[1]))
    figure.align_ylabels([above, roll])
    slab_view.show(0)
    canvas.draw()
    # the layout is that of the first frame: later ones must not jump
    figure.set_layout_engine("none")
    canvas.draw()
    at_rest = canvas.copy_from_bbox(figure.bbox)
    with_slab, drawn = at_rest, -1
    for k, time in enumerate(times):
        number = int(np.flatnonzero(slabs["delivered"].values <= time + 1e-9)[-1])
        if number != drawn:
            canvas.restore_region(at_rest)
            _draw(view, slab_view.show(number))
            with_slab, drawn = canvas.copy_from_bbox(figure.bbox), number
        canvas.restore_region(with_slab)
        for part in (*moving, slab_view):
            _draw(part.axes, part.at(k, time))
        words = ", ".join(
            f"{flight_style(mode, series)[0]} {np.degrees(states[mode]['roll'][k]):+.1f}°"
            for mode in _WINGS
        )
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        yield Frame(pixels, f"{time:.1f} s: roll angle {words}", time)


States = dict[str, dict[str, np.ndarray]]
"""Quantities of each flight, an element for each frame."""


def _draw(axes: Axes, artists: list[Artist]) -> None:
    for artist in artists:
        axes.draw_artist(artist)


class _SlabView:
    """The slab that was delivered last, with its vectors and vortices; time and scales."""

    def __init__(
        self,
        axes: Axes,
        track: xr.Dataset,
        slabs: xr.Dataset,
        states: States,
        limits: tuple[float, float],
    ) -> None:
        self.axes, self._track, self._slabs, self._limits = axes, track, slabs, limits
        self._x = states["feedforward"]["x"]
        axes.set(xlabel="y / m (port is left)", ylabel="z / m")
        self._scale = AnchoredSizeBar(
            axes.transData,
            SCALE_LENGTH,
            f"{SCALE_LENGTH:g} m",
            "lower left",
            color="white",
            frameon=False,
            pad=0.6,
            size_vertical=0.6,
        )
        self._scale.txt_label.get_children()[0].set_path_effects(_EDGE)
        self._words = AnchoredText("", "upper right", frameon=True, pad=0.25, prop={"size": 10})
        self._words.patch.set(alpha=0.75, lw=0)
        for artist in (self._scale, self._words):
            axes.add_artist(artist).set_animated(True)
        self._shown: list[Artist] = []

    def show(self, number: int) -> list[Artist]:
        """A slab in place of the one before."""
        for artist in self._shown:
            artist.remove()
        before = set(self.axes.get_children())
        self._slab = self._slabs.isel(slab=number)
        x = float(self._slab["x"])
        draw_image(self.axes, self._slab, self._limits)
        _draw_vectors(self.axes, self._slab)
        draw_vortices(
            self.axes, self._track.isel(slab=int(np.argmin(np.abs(self._track["x"].values - x))))
        )
        added = [a for a in self.axes.get_children() if a not in before]
        for artist in added:
            artist.set_animated(True)
        self._shown = sorted(added, key=lambda artist: artist.get_zorder())
        return self._shown

    def at(self, k: int, time: float) -> list[Artist]:
        """What moves, in frame k."""
        ahead = float(self._slab["x"]) - self._x[k]
        where = f"{ahead:.0f} m ahead" if ahead >= 0 else f"{-ahead:.0f} m behind"
        self._words.txt.set_text(f"t = {time:5.2f} s, slab {where}")
        return [self._scale, self._words]


def _draw_vectors(axes: Axes, slab: xr.Dataset) -> None:
    """Winds with a dark edge, seen on bright and on dark backscatter, and their scale."""
    if "v" not in slab:
        return
    y, z = np.meshgrid(slab["y"], slab["z"])
    # a wind of 10 m/s is 1.6 times as long as vectors are apart
    step = float(slab["y"][1] - slab["y"][0])
    arrows = axes.quiver(
        y,
        z,
        slab["v"],
        slab["w"],
        color="#ffd23f",
        edgecolor="#222222",
        linewidth=0.5,
        angles="xy",
        scale_units="xy",
        scale=SCALE_SPEED / (1.6 * step),
        width=0.0045,
        zorder=3,
    )
    style = {"labelpos": "N", "labelcolor": "white", "coordinates": "axes"}
    key = axes.quiverkey(arrows, 0.92, 0.04, SCALE_SPEED, f"{SCALE_SPEED:g} m/s", **style)
    key.text.set_path_effects(_EDGE)


class _Wings:
    """The wings in two flights, at their places across the path."""

    def __init__(self, axes: Axes, series: xr.Dataset, states: States, span: float) -> None:
        self.axes = axes
        self._states = states
        self._ends = np.array([-1, 1]) * span / 2
        self._lines = {}
        for mode in _WINGS:
            label, colour, _ = flight_style(mode, series)
            self._lines[mode] = axes.plot(
                [], [], color=colour, lw=3, solid_capstyle="round", label=label, animated=True
            )[0]
        self._legend = axes.legend(fontsize=8, loc="upper left", framealpha=0.75)
        self._legend.set_animated(True)

    def at(self, k: int, time: float) -> list[Artist]:
        for mode, line in self._lines.items():
            y, z, angle = (self._states[mode][name][k] for name in ("y", "z", "roll"))
            # rolled with the port wing, which is on the left, up
            line.set_data(y + self._ends * np.cos(angle), z + self._ends * np.sin(angle))
        return [*self._lines.values(), self._legend]


class _FromAbove:
    """The path: true vortices, those tracked so far, the aircraft, the beams while it scans."""

    def __init__(
        self, axes: Axes, series: xr.Dataset, track: xr.Dataset, slabs: xr.Dataset, states: States
    ) -> None:
        self.axes = axes
        self._x, self._y = states["feedforward"]["x"], states["feedforward"]["y"]
        self._delivered, self._planes = track["delivered"].values, track["x"].values
        self._found = {side: track[f"{side}_y"].sel(source="track").values for side in SIDES}
        lidar = series.sel(flight="feedforward")
        at_scan = np.interp(slabs["time"], lidar["time"], lidar["x"])
        # of the slabs half way between their two scans; beams have one width from scan to scan
        self._reach = float(np.median(slabs["x"].values - at_scan))
        period = float(np.diff(slabs["time"]).min()) if slabs.sizes["slab"] > 1 else 0.0
        self._last_scan = float(slabs["time"].max()) + period / 2
        low, high = float(slabs["image_y"].min()), float(slabs["image_y"].max())
        self._sides = (low, high)
        for side in SIDES:
            truth = track[f"{side}_y"].sel(source="truth")
            axes.plot(track["x"], truth, color="k", lw=0.9)
        self._tracked = {
            side: axes.plot([], [], color=colour, lw=2, animated=True)[0]
            for side, colour in SIDES.items()
        }
        (self._beams,) = axes.fill([0], [0], color="tab:cyan", alpha=0.25, lw=0, animated=True)
        (self._place,) = axes.plot([], [], marker=">", color="tab:blue", ms=9, animated=True)
        axes.set(xlabel="x along the path / m", ylabel="y / m")
        axes.set_xlim(0, float(series["x"].max()))
        axes.set_ylim(1.6 * low, 1.6 * high)
        axes.grid(alpha=0.3)

    def at(self, k: int, time: float) -> list[Artist]:
        delivered = self._delivered <= time + 1e-9
        for side, line in self._tracked.items():
            line.set_data(self._planes[delivered], self._found[side][delivered])
        x, y, end = self._x[k], self._y[k], self._x[k] + self._reach
        low, high = self._sides
        self._beams.set_xy([[x, y], [end, y + low], [end, y + high]])
        self._place.set_data([x], [y])
        scanning = time <= self._last_scan + 1e-9
        return [*([self._beams] if scanning else []), *self._tracked.values(), self._place]


class _Rolled:
    """The roll angles so far."""

    def __init__(self, axes: Axes, series: xr.Dataset) -> None:
        self.axes, self._lines = axes, {}
        self._time = series["time"].values
        self._angles = {
            str(mode): np.degrees(series["roll"].sel(flight=mode).values)
            for mode in series["flight"].values
        }
        for mode in self._angles:
            label, colour, style = flight_style(mode, series)
            axes.plot([], [], color=colour, ls=style, lw=1.6, label=label)
            self._lines[mode] = axes.plot([], [], color=colour, ls=style, lw=1.6, animated=True)[0]
        largest = float(np.degrees(np.abs(series["roll"]).max())) * 1.1 or 1.0
        axes.set(xlabel="time of flight / s", ylabel="roll / degrees")
        axes.set_xlim(0, float(series["time"].max()))
        # the legend is above the curves
        axes.set_ylim(-largest, 2 * largest)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="upper left", ncols=3)

    def at(self, k: int, time: float) -> list[Artist]:
        done = self._time <= time
        for mode, line in self._lines.items():
            line.set_data(self._time[done], self._angles[mode][done])
        return list(self._lines.values())
