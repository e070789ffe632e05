"""When the beams of a scan are sent, and what wrong poses make of the wind."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.assessment.figures.plates import Drawn, frame, image_panel, save_all, sheet
from lidar_mi.assessment.metrics.pointing import ScanPointing, apparent_wind

# Arrows along the image's width.
_ARROWS = 21


def draw_all(folder: Path, pointing: ScanPointing, log: Callable) -> list[Drawn]:
    """Draw the figure of beam times and poses."""
    plates = [("fig24_scan_time", "Times and places of the beams", _scan_time(pointing))]
    return save_all(folder, plates, log)


def _scan_time(pointing: ScanPointing):
    nodes = pointing.on_nodes()
    figure, ((first, second, third),) = sheet(1, 3)
    time, dims = 1e3 * pointing.time[0], ("z", "y")
    if nodes:
        image_panel(
            first, _field(time, pointing, dims), "time of each beam, first scan", "t / ms",
            cmap="viridis",
        )  # fmt: skip
    else:
        frame(first, pointing.y, pointing.z, "time of each beam, first scan")
        y, z = pointing.places[0].T
        dots = first.scatter(y, z, c=time, s=2, linewidths=0, rasterized=True)
        figure.colorbar(dots, ax=first, label="t / ms", pad=0.02)
    for scan in range(2):
        order = np.argsort(pointing.time[scan], kind="stable")
        when = 1e3 * (pointing.time[scan][order] + scan * pointing.dt)
        for axis, (name, colour) in enumerate((("y", "C0"), ("z", "C1"))):
            error = 100 * pointing.errors[scan, order, axis]
            label = None if scan else name
            second.plot(when, error, ".", color=colour, markersize=1, rasterized=True, label=label)
    second.legend(loc="best", markerscale=8)
    second.set(
        title="true less reported place of the beams",
        xlabel="time since the first scan's reference time / ms",
        ylabel="cm at the slab",
    )
    if nodes:
        v, w = (_field(part, pointing, dims) for part in apparent_wind(pointing).T)
        speed = np.hypot(v, w)
        image_panel(third, speed, "apparent wind", "m/s", cmap="magma")
        step = max(1, pointing.y.size // _ARROWS)
        some = slice(step // 2, None, step)
        third.quiver(
            v["y"].values[some], v["z"].values[some], -v.values[some, some], w.values[some, some],
            color="w",
        )  # fmt: skip
    else:
        third.set_axis_off()
        third.text(0.5, 0.5, "beams of both scans\nat different places", ha="center", va="center")
    caption = (
        "Left: time of each beam from the middle of its scan. Middle: how far beams are from where "
        "they are reported, in both scans. Right: the wind that this alone is taken for, the "
        "difference between the scans over the time between them. It is common to all methods."
    )
    return figure, caption


def _field(values: np.ndarray, pointing: ScanPointing, dims) -> xr.DataArray:
    """Values of beams at the nodes, film order, as an image (z, y), ascending."""
    image = values.reshape(pointing.z.size, pointing.y.size)[::-1, ::-1]
    return xr.DataArray(image, {"z": pointing.z, "y": pointing.y}, dims)
