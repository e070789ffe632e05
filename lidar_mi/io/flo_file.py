"""Displacements as optical flow, in Middlebury's format."""

from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.io.atomic import write_atomically

_UNKNOWN = 1e10
"""An unknown vector, in the format any value above 1e9."""


def write_flo(path: str | Path, wind: xr.Dataset, pixel: tuple[float, float]) -> None:
    """Write displacements in pixels, to the right and downwards, float32, top row first.

    Standard errors, places, times and the reasons of flags are lost. Vectors that are flagged or
    missing are unknown, 1e10. ``displacement_y`` and ``displacement_z`` are in m, as are the pixels
    along z and y.
    """
    # y is to the left and z up, both ascend
    down, right = (
        -wind[f"displacement_{axis}"].transpose("z", "y").values[::-1, ::-1] / size
        for axis, size in zip("zy", pixel, strict=True)
    )
    flow = np.stack([right, down], -1)
    valid = (wind["flag"].transpose("z", "y").values[::-1, ::-1] == 0) & np.isfinite(flow).all(-1)
    flow = np.where(valid[..., None], flow, _UNKNOWN).astype("<f4")
    height, width = valid.shape
    head = b"PIEH" + np.array([width, height], "<i4").tobytes()
    write_atomically(path, head + flow.tobytes())
