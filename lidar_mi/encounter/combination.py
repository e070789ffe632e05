"""The wind of both lidars in a slab ahead of a flying aircraft."""

import numpy as np
import xarray as xr

from lidar_mi.retrieval.lines.combine import combine


def combined_in_flight(
    wind: xr.Dataset, lines: xr.Dataset, place: np.ndarray, x: float, crossflow_std: float | None
) -> xr.Dataset:
    """u, v, w of a slab from its images' wind and its lines of sight.

    Parameters
    ----------
    wind : Dataset, dims (z, y)
        Of the images, path frame.
    lines : Dataset, dim line
        From a telescope at the origin, with axes as of the path frame.
    place : array (3,)
        Of the telescope, m, path frame.
    x : float
        Plane of the slab, m.
    crossflow_std : float, optional
        As `combine` takes it.

    Returns
    -------
    Dataset, dims (z, y)
        From `combine`, path frame. Air that moves along x within its slab, whose gates are fixed in
        the air, moves in the images since beams are oblique: this is taken off.

    Raises
    ------
    InputError
        No valid vector or no line of sight on the grid.
    """
    told = {axis: wind[axis] for axis in ("z", "y")}
    seen = {axis: told[axis] - at for axis, at in (("y", place[1]), ("z", place[2]))}
    local = wind.assign_coords({axis: c.assign_attrs(told[axis].attrs) for axis, c in seen.items()})
    found = combine(local, lines, crossflow_std=crossflow_std, distance=x - place[0])
    return found.assign_coords(told)
