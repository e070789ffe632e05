"""Two vortices in a crosswind: images of air that moves everywhere."""

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from tests.support.flows import axes, origin, plane_waves, texture

DT = 0.1


def crosswind_pair(seed, length=3.5, noise=0.03, *, size, mean, circulation=200.0, separation=40.0):
    """Images (arrays) of `size` (columns, rows) with `mean` (v, w), m/s, and v at the pixels."""
    y, z = axes(*size)
    grid = np.meshgrid(y, z)
    vortices = vortex_pair(circulation, separation, 3.0)

    def wind(y, z):
        return [part + more for part, more in zip(velocity(vortices, y, z), mean, strict=True)]

    waves, random = plane_waves(seed, length, 0.5), np.random.default_rng(seed)
    return [
        texture(waves, *place) + noise * random.standard_normal(size[::-1])
        for place in (grid, origin(wind, *grid, DT))
    ], wind(*grid)[0]
