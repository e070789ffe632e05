"""Air of a simulation: a volume in the frame of its mean wind, frozen or a series of states."""

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

    flow: u, v and w on (x, y, z), even.
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
    """A volume of air in the frame that moves with its mean wind at a height: frozen, or a series.

    Interpolated by cubic splines in space and linearly in time, between the states before and after
    that the mean wind carries to the same instant. Beyond its edges the wind is that at the edge:
    `missing` says where places are outside.

    flow: u, v and w (m/s) on (x, y, z), m, even, 4 nodes or more along each; z above the ground.
        With the dimension time (s, ascending, 0 as the path starts) it is a series of states.
    start: x in the volume of the start of the path, m.
    centre: y in the volume of the path, m.
    height: at which the mean wind is that of the frame, m.
    largest_divergence: rms of the divergence over that of the velocity gradient, at most.

    Raises InputError: fewer nodes, or a field with divergence.
    """

    flow: xr.Dataset
    start: float
    centre: float
    height: float
    largest_divergence: float = LARGEST_DIVERGENCE

    def __post_init__(self) -> None:
        for name in "xyz":
            if self.flow.sizes[name] < 4:
                raise InputError(
                    f"encounter.air.volume.file: {self.flow.sizes[name]} nodes along {name} are "
                    "not allowed; expected 4 or more"
                )
        fraction = divergence_fraction(self._state(0))
        if fraction > self.largest_divergence:
            raise InputError(
                f"encounter.air.volume.file: the rms divergence is {fraction:.2g} times that of "
                f"the velocity gradient; expected air without divergence, at most "
                f"{self.largest_divergence:g} (0.58 is noise), or another "
                "encounter.air.volume.largest_divergence"
            )

    @cached_property
    def times(self) -> np.ndarray:
        """Times of the states, s; one for frozen air."""
        return self.flow["time"].values if "time" in self.flow.dims else np.zeros(1)

    def _state(self, index: int) -> xr.Dataset:
        return self.flow.isel(time=index) if "time" in self.flow.dims else self.flow

    @cached_property
    def mean_wind(self) -> tuple[float, float]:
        """Mean u and v of the volume at the height, m/s, over all states."""
        averaged = [name for name in ("time", "x", "y") if name in self.flow.dims]
        level = self.flow[["u", "v"]].mean(averaged).interp(z=self.height)
        # beyond the lowest and highest nodes, the nearest
        nearest = self.flow[["u", "v"]].mean(averaged).sel(z=self.height, method="nearest")
        wind = level.where(np.isfinite(level), nearest)
        return float(wind["u"]), float(wind["v"])

    def _moved(self, last: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """How far the mean wind has carried the air at the first and at the last state needed, m.

        Frozen air has a single state.
        """
        state = min(int(np.searchsorted(self.times, last)), len(self.times) - 1)
        u, v = self.mean_wind
        ends = float(self.times[0]), float(self.times[state])
        return (u * ends[0], u * ends[1]), (v * ends[0], v * ends[1])

    def missing(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, last: float = 0.0
    ) -> dict[str, tuple[float, float, float, float]]:
        """Axes too short for the places: extent of the axis and of the places, m.

        With states until the time ``last`` (s) of a series.
        """
        along, across = self._moved(last)
        places = (
            np.add.outer(np.asarray(x, float) + self.start, along),
            np.add.outer(np.asarray(y, float) + self.centre, across),
            z,
        )
        extents = {}
        for name, place in zip("xyz", places, strict=True):
            nodes = self.flow[name].values
            low, high = float(np.min(place)), float(np.max(place))
            step = nodes[1] - nodes[0]
            if low < nodes[0] - step / 2 or high > nodes[-1] + step / 2:
                extents[name] = (float(nodes[0]), float(nodes[-1]), low, high)
        return extents

    @cached_property
    def _splines(self) -> dict[int, list[np.ndarray]]:
        return {}

    def _spline(self, index: int) -> list[np.ndarray]:
        if index not in self._splines:
            means, state = (*self.mean_wind, 0.0), self._state(index)
            self._splines[index] = [
                spline_filter(
                    state[n].transpose("x", "y", "z").values - mean,
                    mode="nearest",
                    output=np.float32,
                )
                for n, mean in zip("uvw", means, strict=True)
            ]
        return self._splines[index]

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        places = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        shape = places[0].shape
        at_x, at_y, at_z, times = (part.ravel() for part in places)
        wind, count = np.zeros((3, times.size)), len(self.times)
        # as an index: halfway between the states 1 and 2 is 1.5
        position = np.interp(times, self.times, np.arange(count)) if count > 1 else 0.0 * times
        mean_u, mean_v = self.mean_wind
        for index in np.unique([np.floor(position), np.ceil(position)]).astype(int):
            weight = np.clip(1 - np.abs(position - index), 0, None)
            weighted = weight > 0
            passed = self.times[index]
            in_volume = (
                at_x[weighted] + self.start + mean_u * passed,
                at_y[weighted] + self.centre + mean_v * passed,
                at_z[weighted],
            )
            at = np.stack(
                [self._index(n, place) for n, place in zip("xyz", in_volume, strict=True)]
            )
            for component, coefficients in enumerate(self._spline(index)):
                wind[component, weighted] += weight[weighted] * map_coordinates(
                    coefficients, at, output=float, mode="nearest", prefilter=False
                )
        u, v, w = wind.reshape(3, *shape)
        return u, v, w

    def _index(self, name: str, place: np.ndarray) -> np.ndarray:
        """Fractional index of places along an axis, within it."""
        nodes = self.flow[name].values
        step = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
        return np.clip((place - nodes[0]) / step, 0, len(nodes) - 1)
