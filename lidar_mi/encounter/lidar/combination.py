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

    common: standard error of v and w by unknown pointing, m/s.
    rotation: by unknown roll, rad/s.
    offset {"known", "free"}: as `with_common_error` takes it.
    place (3,): of the telescope of the lines of sight, m, path frame.
    roll_axis: y and z of the axis of the roll, m.
    x: plane of the slab, m.
    crossflow_std: as `combine` takes it.
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

    wind (z, y): of the images, path frame.
    lines (line): from a telescope at the origin, with axes as of the path frame.
    place (3,): of the telescope, m, path frame.
    x: plane of the slab, m.
    crossflow_std: as `combine` takes it.

    Raises InputError: no valid vector or no line of sight on the grid.

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
