"""Tilt of a lidar that its directions do not contain."""

import numpy as np
import xarray as xr


def unapplied_tilt(lines: xr.Dataset) -> float:
    """Largest tilt that was not applied to the directions, rad."""
    if "not applied" not in str(lines.attrs.get("tilt", "")):
        return 0.0
    pitch, roll = (np.deg2rad(np.nan_to_num(lines[name].values)) for name in ("pitch", "roll"))
    return float(np.hypot(pitch, roll).max())
