"""Figures of a calibration: where the frames differ from the model, and how they drifted."""

import numpy as np
from matplotlib.figure import Figure

from lidar_mi.retrieval.rings.calibration import Calibration


def draw_calibration(found: Calibration) -> Figure:
    """Mean misfit over the camera, masked pixels, and the drift from frame to frame."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    height, width = found.shape
    rows, columns = found.misfit.shape
    extent = (-0.5, columns * found.block - 0.5, rows * found.block - 0.5, -0.5)
    shown = left.imshow(found.misfit, cmap="RdBu_r", vmin=-4, vmax=4, extent=extent)
    figure.colorbar(shown, ax=left, label="mean misfit / standard deviation")
    y, x = np.nonzero(found.response == 0)
    left.plot(x, y, ".", color="black", ms=2, label=f"{len(x)} pixels masked")
    left.plot(*found.centre, "+", color="black", ms=12)
    left.set(
        xlim=(-0.5, width - 0.5),
        ylim=(height - 0.5, -0.5),
        xlabel="x / px",
        ylabel="y / px",
        title=f"Blocks of {found.block} px; chi-square {found.chi_square:.3f}",
    )
    left.legend(loc="upper right", fontsize="small")
    number = np.arange(len(found.frame_speed))
    right.errorbar(number, found.frame_speed, found.frame_speed_std, fmt="o", ms=3, color="0.2")
    right.axhline(0, color="0.7", lw=0.8)
    right.set(
        xlabel="frame",
        ylabel="drift of laser and etalon / m s$^{-1}$",
        title=f"Beyond noise: {found.drift:.2g} m/s",
    )
    return figure
