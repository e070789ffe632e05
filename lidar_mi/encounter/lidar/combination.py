"""The wind of both lidars in a slab ahead of a flying aircraft."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.combined.combine import combine
from lidar_mi.retrieval.common_error import with_common_error


@dataclass(frozen=True, eq=False)
class Completion:
    """From the wind of a slab's images to the delivered wind.

    Attributes
    ----------
    common : float
        Standard error of v and w by unknown pointing, m/s.
    rotation : float
        By unknown roll, rad/s.
    offset : {"known", "free"}
        As `with_common_error` takes it.
    place : array (3,)
        Of the telescope of the lines of sight, m, path frame.
    roll_axis : (float, float)
        y and z of the axis of the roll, m.
    x : float
        Plane of the slab, m.
    crossflow_std : float, optional
        As `combine` takes it.
    """

    common: float
    rotation: float
    offset: Literal["known", "free"]
    place: np.ndarray
    roll_axis: tuple[float, float]
    x: float
    crossflow_std: float | None

    @property
    def by_pointing(self) -> bool:
        """Whether unknown pointing adds to the errors of the wind."""
        return bool(self.common or self.rotation)

    def __call__(
        self, wind: xr.Dataset, lines: xr.Dataset | None
    ) -> tuple[xr.Dataset, tuple[str, ...]]:
        """The wind with the errors of pointing, combined with lines; flags say why it is not."""
        if self.by_pointing:
            wind = with_common_error(wind, self.common, self.offset, self.rotation, self.roll_axis)
        if lines is None:
            return wind, ()
        try:
            return combined_in_flight(wind, lines, self.place, self.x, self.crossflow_std), ()
        except InputError as error:
            return wind, (f"no wind from both lidars: {error}",)


def combined_in_flight(
    wind: xr.Dataset, lines: xr.Dataset, place: np.ndarray, x: float, crossflow_std: float | None
) -> xr.Dataset:
    """u, v, w of a slab from its images' wind and its lines of sight.

    Raises InputError: no valid vector or no line of sight on the grid.

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
        From `combine`, path frame. Gates are fixed in the air, but air that moves along x within
        its slab moves in the images, since beams are oblique: `combine` subtracts this motion.
    """
    axes = {axis: wind.variables[axis] for axis in ("z", "y")}
    # the lines start at their telescope: so does the frame in which both are combined
    local = wind.assign_coords(
        {
            axis: (axis, axes[axis].values - start, axes[axis].attrs)
            for axis, start in (("y", place[1]), ("z", place[2]))
        }
    )
    combined = combine(local, lines, crossflow_std=crossflow_std, distance=x - place[0])
    return combined.assign_coords(axes)
