"""Vectors of successive slabs in turbulence, as means over windows with noise of known size."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.retrieval.along_path.vectors import SlabVectors

WINDOW, STRIDE, PERIOD, AHEAD = 8.0, 7.5, 0.1, 150.0
"""m, m, s and m."""

# Points of a window along each axis.
_POINTS = 4


def calm(x, y, z, time):
    """Air at rest."""
    return np.zeros((3, *np.broadcast_shapes(*(np.shape(a) for a in (x, y, z, time)))))


def turbulent(sigma, length, seed, **options):
    """Wind of a realisation; waves down to 1 m."""
    return turbulence(sigma, length, seed, shortest=1.0, modes=300, **options).velocity


@dataclass
class Slabs:
    """Slabs ahead of an aircraft at 75 m/s.

    Attributes
    ----------
    air : callable
    noise : float
        Standard error of a vector, m/s.
    resolution : float
        Standard deviation of a Gaussian mean, m; 0: the mean over a window.
    stated : float
        Stated over true errors.
    nz, ny : int
    """

    air: object
    noise: float
    resolution: float = 0.0
    stated: float = 1.0
    seed: int = 1
    nz: int = 8
    ny: int = 13

    def __post_init__(self):
        self._random = np.random.default_rng(self.seed)

    def slab(self, x, time) -> SlabVectors:
        """White noise of the points is averaged as the wind is: errors overlap as windows do."""
        step = WINDOW / _POINTS
        pad = int(np.ceil(3 * self.resolution / step))
        axes = [step * (np.arange(n * _POINTS + 2 * pad) - pad) for n in (self.nz, self.ny)]
        axes = [
            a - step * (n * _POINTS - 1) / 2 for a, n in zip(axes, (self.nz, self.ny), strict=True)
        ]
        z, y = np.meshgrid(*axes, indexing="ij")
        fine = np.stack(self.air(x, y, z, time)[1:])
        if self.resolution:
            white = self.noise * 2 * np.sqrt(np.pi) * self.resolution / step
            fine = fine + white * self._random.normal(size=fine.shape)
            some = slice(pad + _POINTS // 2, -pad, _POINTS)
            wide = self.resolution / step
            wind = np.stack([gaussian_filter(a, wide) for a in fine])[:, some, some]
            axes = [a[some] for a in axes]
        else:
            fine = fine + self.noise * _POINTS * self._random.normal(size=fine.shape)
            shape = (2, self.nz, _POINTS, self.ny, _POINTS)
            wind = fine.reshape(shape).mean((2, 4))
            axes = [a.reshape(-1, _POINTS).mean(1) for a in axes]
        stderr = np.full(wind.shape, max(self.stated * self.noise, 1e-4))
        return SlabVectors(axes[1], axes[0], wind, stderr, WINDOW, np.zeros(2))

    def along_path(self, count) -> Iterator[tuple[float, float, SlabVectors]]:
        """x (m), time (s) and vectors of `count` slabs."""
        for number in range(count):
            x, time = AHEAD + STRIDE * number, PERIOD * number
            yield x, time, self.slab(x, time)
