"""The velocity of filaments, tabulated over one period and interpolated.

Biot-Savart's sum over some hundred nodes takes 10 microseconds a place; a flight asks for millions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.atmosphere.vortices.filaments import Filaments
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.errors import InputError

# The fine grid reaches this many core radii beyond the lines, in l and n: five nodes of the coarse
# grid, over which the error of its splines by the cores falls to 1e-3. The coarse grid reaches this
# many periods.
_FINE_REACH = 8.0
_COARSE_REACH = 0.4
# Spacing across the axis in core radii, of the fine and the coarse grid; along it twice as much in
# the fine one, as lines, except rings, are steep by less than that.
_FINE, _COARSE = 0.4, 1.6
# Periods in core radii up to which both grids have at most some million nodes.
_LONGEST = 400.0
# Nodes beyond the period's ends that a cubic spline needs.
_SPLINE_MARGIN = 3


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cubic splines on a grid, periodic along its first axis."""

    start: np.ndarray
    spacing: np.ndarray
    planes: int
    splines: Sequence[np.ndarray]

    def index(self, places: np.ndarray) -> np.ndarray:
        """(3, n) indices of places (3, n), m."""
        index = (places - self.start[:, None]) / self.spacing[:, None]
        index[0] = np.mod(index[0], self.planes) + _SPLINE_MARGIN
        return index

    def inside(self, index: np.ndarray) -> np.ndarray:
        """Whether the grid holds the indices."""
        last = np.array(self.splines[0].shape[1:])[:, None] - 1
        return np.all((index[1:] >= 0) & (index[1:] <= last), axis=0, keepdims=True)[0]

    def at(self, index: np.ndarray) -> np.ndarray:
        """Velocity (3, n) at indices."""
        return np.stack(
            [
                scipy.ndimage.map_coordinates(spline, index, prefilter=False, mode="mirror")
                for spline in self.splines
            ]
        )


class FilamentTable:
    """Velocity of filaments (circulation 1 m^2/s) by interpolation of two grids.

    Cubic splines of nodes 0.4 core radii apart about the lines, and 1.6 core radii apart
    farther away; beyond that, the flow of the straight pair. Both grids are computed for a quarter
    of a period: the filaments are symmetric to the plane between both vortices, and about their
    crests. ``crest`` is the s of one (m).

    Raises InputError: cores too thin for the grids.
    """

    def __init__(self, filaments: Filaments, crest: float) -> None:
        if filaments.period > _LONGEST * filaments.core_radius:
            raise InputError(
                f"crow: filaments with a core radius of {filaments.core_radius:g} m and waves of "
                f"{filaments.period:.4g} m are not allowed; expected cores of at least "
                f"{filaments.period / _LONGEST:.3g} m"
            )
        self._filaments = filaments
        nodes = np.concatenate([curve.places for curve in filaments.curves])
        radius, period = filaments.core_radius, filaments.period
        wide, low, high = np.abs(nodes[:, 1]).max(), nodes[:, 2].min(), nodes[:, 2].max()
        margin = _FINE_REACH * radius
        along = _FINE if len(filaments.curves) == 1 else 2 * _FINE
        self._fine = self._grid(
            crest,
            (wide + margin, low - margin, high + margin),
            np.array([along, _FINE, _FINE]) * radius,
        )
        reach = _COARSE_REACH * period
        self._coarse = self._grid(
            crest, (wide + reach, low - reach, high + reach), np.full(3, _COARSE * radius)
        )

    def velocity(self, places: np.ndarray) -> np.ndarray:
        """Velocity (3, ...), m/s, at places (3, ...), m, in the filaments' axes."""
        flat = np.reshape(places, (3, -1))
        values = np.empty_like(flat)
        outside = np.arange(flat.shape[1])
        for grid in (self._fine, self._coarse):
            index = grid.index(flat[:, outside])
            inside = grid.inside(index)
            values[:, outside[inside]] = grid.at(index[:, inside])
            outside = outside[~inside]
        values[0, outside] = 0.0
        pair = vortex_pair(
            1.0,
            self._filaments.separation,
            self._filaments.core_radius,
            model=self._filaments.model,
        )
        values[1:, outside] = velocity(pair, flat[1, outside], flat[2, outside])
        return values.reshape(np.shape(places))

    def _grid(self, crest: float, reach: tuple[float, float, float], spacing: np.ndarray) -> _Grid:
        """Splines on a grid to ``reach`` (+-l, lowest n, highest n; m)."""
        period, (wide, low, high) = self._filaments.period, reach
        half = int(np.ceil(period / 2 / spacing[0]))
        side = int(np.ceil(wide / spacing[1]))
        axes = [
            crest + np.arange(half + 1) * (period / 2 / half),
            np.arange(side + 1) * spacing[1],
            low + np.arange(int(np.ceil((high - low) / spacing[2])) + 1) * spacing[2],
        ]
        quarter = self._filaments.velocity(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        # about the plane between the vortices l is odd; about that of a crest s is odd
        left = quarter[:, :0:-1] * np.array([1.0, -1.0, 1.0])
        period_values = np.concatenate([left, quarter], axis=1)
        behind = period_values[-2:0:-1] * np.array([-1.0, 1.0, 1.0])
        period_values = np.concatenate([period_values, behind], axis=0)
        splines = []
        for k in range(3):
            values = scipy.ndimage.spline_filter1d(period_values[..., k], axis=0, mode="grid-wrap")
            for axis in (1, 2):
                values = scipy.ndimage.spline_filter1d(values, axis=axis, mode="mirror")
            splines.append(
                np.take(
                    values,
                    range(-_SPLINE_MARGIN, len(values) + _SPLINE_MARGIN),
                    axis=0,
                    mode="wrap",
                )
            )
        start = np.array([crest, -axes[1][-1], axes[2][0]])
        step = np.array([axes[0][1] - axes[0][0], *spacing[1:]])
        return _Grid(start, step, 2 * half, splines)
