"""A simulated wake along a flight path: one instant of it, repeated along its axis.

Path frame as in `vortices.wake_path`; the wake's own axes are along it, across it to the
left, and up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.atmosphere.vortices.wake_path import Components, check_cut, cut_radius, wake_axes

# Nodes beyond the period's ends that a cubic spline needs.
_SPLINE_MARGIN = 3


@dataclass(frozen=True, eq=False)
class VolumeAlongPath:
    """A simulated wake, repeated along an axis that crosses the flight path.

    The state of one instant moves with ``drift`` and does not change: any further induction in the
    seconds of an encounter is neglected. Values are interpolated by cubic splines, periodic along
    the axis. Outside of the volume the wind is that of two straight vortices at the mean places
    with the mean circulations, the extinction the background.

    flow: one period, from `one_period`: v, w, maybe u (m s^-1) and extinction (m^-1) on (x, y, z).
    port, starboard: in every plane of the period, in its own y and z.
    background: extinction outside of the volume, m^-1.
    drift: across the axis to the left and upwards, m s^-1.
    origin: place in the volume (m) that is met at ``x_c``, ``t_c`` and ``miss``.
    crossing_angle, climb_angle, x_c, t_c, miss: as of
        `lidar_mi.atmosphere.vortices.wake_path.PairAlongPath`.
    """

    flow: xr.Dataset
    port: Sequence[Vortex]
    starboard: Sequence[Vortex]
    background: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crossing_angle: float = 0.0
    climb_angle: float = 0.0
    x_c: float = 0.0
    t_c: float = 0.0
    miss: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors along the wake, across it to the left and upwards, in the path frame."""
        return wake_axes(self.crossing_angle, self.climb_angle)

    @property
    def period(self) -> float:
        """Period of the wake along its axis, m."""
        x = self.flow["x"].values
        return float(x[-1] - x[0]) + self._steps[0]

    @cached_property
    def _steps(self) -> tuple[float, ...]:
        """Spacing of the nodes, m; that of a single plane is 1 m."""
        axes = [self.flow[name].values for name in "xyz"]
        return tuple(float(a[1] - a[0]) if a.size > 1 else 1.0 for a in axes)

    @cached_property
    def _mean_pair(self) -> list[Vortex]:
        sides = (self.port, self.starboard)
        keys = ("circulation", "core_radius", "y", "z")
        means = [[float(np.mean([getattr(v, k) for v in s])) for k in keys] for s in sides]
        return [Vortex(strength, radius, y, z) for strength, radius, y, z in means]

    @cached_property
    def _splines(self) -> dict[str, np.ndarray]:
        """Coefficients of cubic splines, repeated beyond the ends of the period."""
        coefficients = {}
        for name in self.flow.data_vars:
            values = self.flow[name].transpose("x", "y", "z").values.astype(float)
            if len(values) > 1:
                # periodic along the axis: behind the last plane comes the first
                values = scipy.ndimage.spline_filter1d(values, axis=0, mode="grid-wrap")
            for axis in (1, 2):
                values = scipy.ndimage.spline_filter1d(values, axis=axis, mode="mirror")
            coefficients[str(name)] = np.take(
                values, range(-_SPLINE_MARGIN, len(values) + _SPLINE_MARGIN), axis=0, mode="wrap"
            )
        return coefficients

    def centre_at(self, time: ArrayLike) -> np.ndarray:
        """Place (3, ...) of the volume's ``origin`` at a time, path frame, m."""
        passed = np.asarray(time, float) - self.t_c
        _, left, up = self.axes
        start = (self.x_c, *self.miss)
        return np.stack(
            [
                s + passed * (self.drift[0] * a + self.drift[1] * b)
                for s, a, b in zip(start, left, up, strict=True)
            ]
        )

    def _in_volume(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> np.ndarray:
        """Places in the volume's axes, (3, ...), m, from its origin's coordinates on."""
        centre = self.centre_at(time)
        place = [np.asarray(a, float) - c for a, c in zip((x, y, z), centre, strict=True)]
        return np.stack(
            [
                origin + sum(a * b for a, b in zip(place, axis, strict=True))
                for origin, axis in zip(self.origin, self.axes, strict=True)
            ]
        )

    def _indices(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices into the splines, and where the volume has values."""
        index, inside = [], np.ones(places.shape[1:], bool)
        for k, name in enumerate("xyz"):
            nodes = self.flow[name].values
            place = (places[k] - nodes[0]) / self._steps[k]
            if name == "x":
                # the coefficients begin so many nodes before the first plane
                place = np.mod(place, len(nodes)) + _SPLINE_MARGIN
            else:
                # nodes at the rim are inside, whatever the rounding
                inside &= (place >= -1e-9) & (place <= len(nodes) - 1 + 1e-9)
            index.append(place)
        return np.stack(index), inside

    def _at(self, name: str, index: np.ndarray) -> np.ndarray:
        flat = index.reshape(3, -1)
        values = scipy.ndimage.map_coordinates(
            self._splines[name], flat, prefilter=False, mode="mirror"
        )
        return values.reshape(index.shape[1:])

    def wind(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m s^-1) at places (m) and times (s), which broadcast."""
        places = self._in_volume(x, y, z, time)
        index, inside = self._indices(places)
        components = np.zeros_like(places)
        components[1:] = velocity(self._mean_pair, places[1], places[2])
        for k, name in enumerate("uvw"):
            if name in self.flow:
                components[k] = np.where(inside, self._at(name, index), components[k])
        # rows are the wake's unit vectors: their transpose leads back to the path frame
        u, v, w = np.einsum("ki,k...->i...", np.stack(self.axes), components)
        return u, v, w

    def extinction(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> np.ndarray:
        """Aerosol and exhaust without texture, m^-1, at places (m) and times (s)."""
        index, inside = self._indices(self._in_volume(x, y, z, time))
        values = self.flow["extinction"].values
        # a spline exceeds its data at sharp edges
        extinction = self._at("extinction", index).clip(values.min(), values.max())
        return np.where(inside, extinction, self.background)

    @cached_property
    def _tracks(self) -> tuple[scipy.interpolate.CubicSpline, ...]:
        """y, z, radius and circulation of each vortex along the axis, periodic."""
        x = self.flow["x"].values
        # a periodic spline needs its first value again at the end
        nodes = np.append(x, x[0] + self.period)
        tracks = []
        for side in (self.port, self.starboard):
            rows = np.array([[v.y, v.z, v.core_radius, v.circulation] for v in side])
            tracks.append(
                scipy.interpolate.CubicSpline(
                    nodes, np.vstack([rows, rows[:1]]), bc_type="periodic"
                )
            )
        return tuple(tracks)

    def vortices(self, x: float, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex in the plane x at a time.

        Their places are where the lines of the cores cross the plane; cores are given by the circle
        of their area.

        Raises InputError: a wake that lies in the plane.
        """
        check_cut(self.axes[0], self.crossing_angle)
        centre, rotation = self.centre_at(time), np.stack(self.axes)
        vortices = []
        for track in self._tracks:
            s = 0.0
            # by Newton's method: the line is nearly along the axis
            for _ in range(30):
                row, slope = track(self.origin[0] + s), track(self.origin[0] + s, 1)
                place_along = np.array([s, row[0] - self.origin[1], row[1] - self.origin[2]])
                tangent = np.array([1.0, slope[0], slope[1]]) @ rotation
                place = centre + place_along @ rotation
                s -= (place[0] - x) / tangent[0]
            radius, circulation = cut_radius(float(row[2]), tangent), float(row[3])
            vortices.append(Vortex(circulation, radius, float(place[1]), float(place[2])))
        return vortices[0], vortices[1]
