"""Figures of a calibration: where the frames differ from the model, and how they drifted."""

import numpy as np
from matplotlib.figure import Figure

from lidar_mi.retrieval.rings.calibration import Calibration


def draw_calibration(calibration: Calibration) -> Figure:
    """Mean misfit over the camera, masked pixels, and the drift from frame to frame."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    height, width = calibration.shape
    rows, columns = calibration.misfit.shape
    extent = (-0.5, columns * calibration.block - 0.5, rows * calibration.block - 0.5, -0.5)
    mesh = left.imshow(calibration.misfit, cmap="RdBu_r", vmin=-4, vmax=4, extent=extent)
    figure.colorbar(mesh, ax=left, label="mean misfit / standard deviation")
    y, x = np.nonzero(calibration.response == 0)
    left.plot(x, y, ".", color="black", ms=2, label=f"{len(x)} pixels masked")
    left.plot(*calibration.centre, "+", color="black", ms=12)
    left.set(
        xlim=(-0.5, width - 0.5),
        ylim=(height - 0.5, -0.5),
        xlabel="x / px",
        ylabel="y / px",
        title=f"Blocks of {calibration.block} px; chi-square {calibration.chi_square:.3f}",
    )
    left.legend(loc="upper right", fontsize="small")
    k = np.arange(len(calibration.frame_speed))
    right.errorbar(
        k, calibration.frame_speed, calibration.frame_speed_std, fmt="o", ms=3, color="0.2"
    )
    right.axhline(0, color="0.7", lw=0.8)
    right.set(
        xlabel="frame",
        ylabel="drift of laser and etalon / m s$^{-1}$",
        title=f"Beyond noise: {calibration.drift:.2g} m/s",
    )
    return figure
