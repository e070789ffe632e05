"""Air of a simulation: one instant of a volume, frozen in the frame of the mean wind."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates, spline_filter

from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.errors import InputError

LARGEST_DIVERGENCE = 0.2
"""Rms of the divergence over that of the gradient up to which a field counts as without divergence.

Independent noise in every component has 0.577. Differences of a resolved field have less than 0.1;
the limit stands between, and nothing else depends on it.
"""


def divergence_fraction(flow: xr.Dataset) -> float:
    """Rms of the divergence over that of the velocity gradient, by central differences.

    0 for a field without divergence, 0.577 for independent isotropic noise in each component.

    Parameters
    ----------
    flow : xarray.Dataset
        u, v and w on (x, y, z), even.
    """
    axes = [flow[name].values for name in "xyz"]
    gradients = np.array(
        [np.gradient(flow[n].transpose("x", "y", "z").values, *axes, edge_order=2) for n in "uvw"]
    )
    size = float(np.sqrt((gradients**2).sum((0, 1)).mean()))
    divergence = np.einsum("ii...->...", gradients)
    return float(np.sqrt((divergence**2).mean())) / size if size else 0.0


@dataclass(frozen=True, eq=False)
class AirVolume:
    """A volume of air, at rest in the frame that moves with its mean wind at a height.

    Interpolated by cubic splines. Beyond its edges the wind is that at the edge: `missing` says
    where places are outside.

    Parameters
    ----------
    flow : xarray.Dataset
        u, v and w (m/s) on (x, y, z), m, even, 4 nodes or more along each; z above the ground.
    start : float
        x in the volume of the start of the path, m.
    centre : float
        y in the volume of the path, m.
    height : float
        At which the mean wind is that of the frame, m.

    Raises
    ------
    InputError
        Fewer nodes, or a field with divergence.
    """

    flow: xr.Dataset
    start: float
    centre: float
    height: float

    def __post_init__(self) -> None:
        for name in "xyz":
            if self.flow.sizes[name] < 4:
                raise InputError(
                    f"encounter.air.volume.file: {self.flow.sizes[name]} nodes along {name} are "
                    "not allowed; expected 4 or more"
                )
        fraction = divergence_fraction(self.flow)
        if fraction > LARGEST_DIVERGENCE:
            raise InputError(
                f"encounter.air.volume.file: the rms divergence is {fraction:.2g} times that of "
                f"the velocity gradient; expected air without divergence, at most "
                f"{LARGEST_DIVERGENCE:g} (0.58 is noise)"
            )

    @cached_property
    def mean_wind(self) -> tuple[float, float]:
        """Mean u and v of the volume at the height, m/s."""
        level = self.flow[["u", "v"]].mean(("x", "y")).interp(z=self.height)
        # below the lowest or above the highest nodes that of the nearest
        nearest = self.flow[["u", "v"]].mean(("x", "y")).sel(z=self.height, method="nearest")
        found = level.where(np.isfinite(level), nearest)
        return float(found["u"]), float(found["v"])

    def missing(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike
    ) -> dict[str, tuple[float, float, float, float]]:
        """Along each axis that does not hold all places: its extent, and that of the places; m."""
        places = np.asarray(x, float) + self.start, np.asarray(y, float) + self.centre, z
        found = {}
        for name, place in zip("xyz", places, strict=True):
            nodes = self.flow[name].values
            low, high = float(np.min(place)), float(np.max(place))
            step = nodes[1] - nodes[0]
            if low < nodes[0] - step / 2 or high > nodes[-1] + step / 2:
                found[name] = (float(nodes[0]), float(nodes[-1]), low, high)
        return found

    @cached_property
    def _splines(self) -> list[np.ndarray]:
        means = (*self.mean_wind, 0.0)
        return [
            spline_filter(
                self.flow[n].transpose("x", "y", "z").values - mean,
                mode="nearest",
                output=np.float32,
            )
            for n, mean in zip("uvw", means, strict=True)
        ]

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        given = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        own = given[0] + self.start, given[1] + self.centre, given[2]
        index = []
        for name, place in zip("xyz", own, strict=True):
            nodes = self.flow[name].values
            step = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
            index.append(np.clip((place - nodes[0]) / step, 0, len(nodes) - 1).ravel())
        at, shape = np.stack(index), given[0].shape
        u, v, w = (
            map_coordinates(one, at, output=float, mode="nearest", prefilter=False).reshape(shape)
            for one in self._splines
        )
        return u, v, w
