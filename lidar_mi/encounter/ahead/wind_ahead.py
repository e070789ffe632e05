"""The wind ahead of an aircraft from the vectors of the slabs, with or without a pair of vortices.

Vortices that are tracked are subtracted from the vectors; what remains is the wind of the air about
them. Without a track it is all of the wind.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.retrieval.along_path.smoother import (
    Lattice,
    Observation,
    PathField,
    basis,
    observation,
    smoothed,
)
from lidar_mi.retrieval.along_path.statistics import Statistics, StatisticsEstimator
from lidar_mi.retrieval.along_path.vectors import ACROSS, SlabVectors, counting, slab_vectors

Vortices = Callable[..., np.ndarray]
"""v and w (2, ...) of tracked vortices alone, m/s, from x, y, z (m), time (s) and the standard
deviation (m) of a Gaussian mean."""

# Reach of the lattice beyond the wing's tips and above and below the path, m: the aircraft may
# leave the path by so much.
_MARGIN = 8.0
# Slabs behind the aircraft that are stored: a correlation length of what the vectors resolve.
_BEHIND = 4
# Changes of the statistics, relative, for which slabs are not evaluated again.
_NEARLY = 0.15
# Variance of a vector near a core over its own beyond which statistics do without it.
_UNCERTAIN = 4.0


@dataclass(eq=False)
class _Seen:
    x: float
    time: float
    vectors: SlabVectors
    observations: list[Observation] | None = None


@dataclass(eq=False)
class WindAhead:
    """Learns the wind ahead of a wing of a span (m) from slab to slab, a stride (m) apart."""

    stride: float
    span: float
    _estimator: StatisticsEstimator = field(init=False)
    _slabs: list[_Seen] = field(default_factory=list)
    _fields: list[PathField] = field(default_factory=list)
    _known: tuple[Statistics, Lattice] | None = None
    _subtracted: bool = False

    def __post_init__(self) -> None:
        self._estimator = StatisticsEstimator(self.stride)

    def __bool__(self) -> bool:
        return bool(self._fields)

    @property
    def statistics(self) -> Statistics | None:
        """Of the air and the vectors, as the wind is estimated by them."""
        return self._known[0] if self._known else None

    def add(
        self, x: float, time: float, wind: xr.Dataset, vortices: Vortices | None, behind: float
    ) -> None:
        """Take in the wind of a slab.

        x, time: plane of the slab, m, and the time at which its wind is valid, s.
        wind (z, y): as of `Estimate.wind`.
        vortices: those that are tracked; None: there are none.
        behind: place of the aircraft, m: slabs far behind it are forgotten.
        """
        self._slabs = [s for s in self._slabs if s.x > behind - _BEHIND * self.stride and s.x < x]
        self._slabs.append(_Seen(x, time, slab_vectors(counting(wind))))
        anew = self._subtracted != (vortices is not None)
        if anew:
            self._estimator = StatisticsEstimator(self.stride)
        self._subtracted = vortices is not None
        resolution = self._known[0].resolution if self._known else 0.0
        air, extra = zip(*(_without(vortices, s, resolution) for s in self._slabs), strict=True)
        for number, slab in enumerate(self._slabs):
            if anew or slab.x == x:
                certain = extra[number] < _UNCERTAIN * slab.vectors.stderr**2
                one = np.where(certain.all(0), air[number], np.nan)
                self._estimator.add(slab.x, replace(slab.vectors, wind=one))
        statistics = self._estimator.statistics
        if statistics is None:
            return
        self._settle(statistics, anew)
        self._fields = self._smoothed(air, extra)

    def at(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike, *, error: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """v and w (2, ...) of the air about vortices at places (m) and times (s), m/s.

        With their standard errors, zero without `error`. Places and times broadcast.
        """
        given = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        flat = [a.ravel() for a in given]
        winds = [one.at(*flat, error=error) for one in self._fields]
        mean, stderr = np.moveaxis(np.array(winds), 1, 0).reshape(2, 2, *given[0].shape)
        return mean, stderr

    def _settle(self, statistics: Statistics, anew: bool) -> None:
        """Take statistics and lattice as before where they nearly are."""
        lattice = Lattice(self.span / 2 + _MARGIN, _MARGIN, self._slabs[-1].vectors.window).through(
            self._slabs[-1].vectors
        )
        if self._known and not anew and self._known[1] == lattice:
            before = self._known[0]
            same = all(
                abs(getattr(before, name) - getattr(statistics, name))
                <= _NEARLY * getattr(before, name)
                for name in ("sigma", "length", "resolution", "scale")
            )
            if same and before.shape == statistics.shape:
                return
        self._known = statistics, lattice
        for slab in self._slabs:
            slab.observations = None

    def _smoothed(self, air: Sequence[np.ndarray], extra: Sequence[np.ndarray]) -> list[PathField]:
        assert self._known is not None  # as settled
        statistics, lattice = self._known
        bases = [
            basis(
                name,
                statistics.length,
                statistics.resolution,
                statistics.shape,
                self.stride,
                lattice,
            )
            for name in ACROSS
        ]
        for slab, more in zip(self._slabs, extra, strict=True):
            if slab.observations is None:
                slab.observations = [
                    observation(one, statistics, slab.vectors, more[k])
                    for k, one in enumerate(bases)
                ]
        known = [a[np.isfinite(a)] for a in air]
        # large eddies sweep small ones past a place (Tennekes 1975)
        square = np.concatenate(known) ** 2
        swept = float(np.sqrt(square.mean())) if square.size else 0.0
        return [
            smoothed(
                one,
                statistics,
                [slab.x for slab in self._slabs],
                [slab.time for slab in self._slabs],
                [slab.observations[k] for slab in self._slabs if slab.observations],
                [wind[k] for wind in air],
                swept,
            )
            for k, one in enumerate(bases)
        ]


def _without(
    vortices: Vortices | None, slab: _Seen, resolution: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (2, nz, ny) without the vortices, and the variance that this adds to them.

    A vector is a mean of the wind. Near a core it is between that over the window and that over
    what is resolved elsewhere, a Gaussian as wide as the window at least: retrievals resolve more
    where there is more.
    """
    vectors = slab.vectors
    if vortices is None:
        return vectors.wind, np.zeros_like(vectors.wind)
    least = vectors.window / np.sqrt(12)
    y, z = np.meshgrid(vectors.y, vectors.z)
    place = np.full(y.shape, slab.x), y, z, np.full(y.shape, slab.time)
    fine, coarse = (vortices(*place, width) for width in (least, max(vectors.window, resolution)))
    # uniform between both
    return vectors.wind - (fine + coarse) / 2, (fine - coarse) ** 2 / 12
