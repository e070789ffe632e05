"""When the beams of a scan are sent, and what wrong poses make of the wind."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    arrow_scale,
    frame,
    image_panel,
    save_all,
    sheet,
    speed_of,
)
from lidar_mi.assessment.metrics.pointing import ScanPointing, apparent_wind

# Arrows along the image's width.
_ARROWS = 21


def draw_all(folder: Path, pointing: ScanPointing, log: Progress) -> list[Drawn]:
    """Draw the figure of beam times and poses."""
    figures = [("fig24_scan_time", "Times and places of the beams", _scan_time(pointing))]
    return save_all(folder, figures, log)


def _scan_time(pointing: ScanPointing) -> Captioned:
    wrong = bool(np.abs(pointing.errors).max() > 0)
    panels = [_times, _errors, _wind] if pointing.on_nodes() else [_times, _errors]
    panels = panels if wrong else [_times]
    figure, (axes,) = sheet(1, len(panels))
    for panel, place in zip(panels, axes, strict=True):
        panel(place, pointing)
    caption = {
        _times: "Time of each beam from the middle of its scan.",
        _errors: "How far beams are from where they are reported, in both scans.",
        _wind: "The wind that this alone is taken for: the difference between the scans over the "
        "time between them. It is common to all methods.",
    }
    return figure, " ".join(caption[panel] for panel in panels)


def _times(axes: Axes, pointing: ScanPointing) -> None:
    time, title = 1e3 * pointing.time[0], "time of each beam, first scan"
    if pointing.on_nodes():
        image_panel(axes, _field(time, pointing), title, "t / ms", cmap="viridis")
        return
    frame(axes, pointing.y, pointing.z, title)
    y, z = pointing.places[0].T
    dots = axes.scatter(y, z, c=time, s=2, linewidths=0, rasterized=True)
    axes.figure.colorbar(dots, ax=axes, label="t / ms", pad=0.02)


def _errors(axes: Axes, pointing: ScanPointing) -> None:
    for scan in range(2):
        when = 1e3 * (pointing.time[scan] + scan * pointing.dt)
        for axis, (name, colour) in enumerate((("y", "C0"), ("z", "C1"))):
            error = 100 * pointing.errors[scan, :, axis]
            label = None if scan else name
            axes.plot(when, error, ".", color=colour, markersize=1, rasterized=True, label=label)
    axes.legend(loc="best", markerscale=8)
    axes.set(
        title="true less reported place of the beams",
        xlabel="time since the first scan's reference time / ms",
        ylabel="cm at the slab",
    )


def _wind(axes: Axes, pointing: ScanPointing) -> None:
    v, w = (_field(part, pointing) for part in apparent_wind(pointing).T)
    image_panel(axes, speed_of(v, w), "apparent wind", "m/s", cmap="magma")
    step = max(1, pointing.y.size // _ARROWS)
    some = slice(step // 2, None, step)
    v, w = v[some, some], w[some, some]
    # port, towards larger y, is on the left
    if (largest := float(speed_of(v, w).max())) > 0:
        arrows = axes.quiver(v["y"].values, v["z"].values, -v.values, w.values, color="w")
        arrow_scale(axes, arrows, largest)


def _field(values: np.ndarray, pointing: ScanPointing) -> xr.DataArray:
    """Values of beams at the nodes, film order, as an image (z, y), ascending."""
    image = values.reshape(pointing.z.size, pointing.y.size)[::-1, ::-1]
    return xr.DataArray(image, {"z": pointing.z, "y": pointing.y}, ("z", "y"))
