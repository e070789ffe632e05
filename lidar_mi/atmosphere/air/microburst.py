"""A microburst: the stagnation flow of Oseguera and Bowles.

Source: Oseguera and Bowles, A Simple, Analytic 3-Dimensional Downburst Model Based on Boundary
Layer Stagnation Flow, NASA TM-100632, 1988.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.errors import InputError

OUTFLOW_HEIGHT = 0.22
"""Height of the largest outflow over z*, the depth of the outflow."""

BOUNDARY_LAYER = 12.5
"""z* over the height of the boundary layer."""


LARGEST_OUTFLOW = 0.2357
"""Largest outflow over lambda R."""


@dataclass(frozen=True)
class Microburst:
    """An axisymmetric downdraft that spreads at the ground, steady and without divergence.

    u_r = lambda R^2/(2 r) (1 - exp(-r^2/R^2)) (exp(-z/z*) - exp(-z/e)),
    w = -lambda exp(-r^2/R^2) (e (exp(-z/e) - 1) - z* (exp(-z/z*) - 1)).

    outflow: the largest, m/s; lambda = outflow / (0.2357 R).
    radius: R of the downdraft, m.
    outflow_height: height of the largest outflow, m: 0.22 z*. e = z*/12.5.
    x, y: of its axis, m.
    """

    outflow: float
    radius: float
    outflow_height: float
    x: float
    y: float = 0.0

    def __post_init__(self) -> None:
        for name in ("outflow", "radius", "outflow_height"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"microburst.{name}: {value} is not allowed; expected above 0")

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast; 0 below the ground."""
        from_axis = np.asarray(x, float) - self.x, np.asarray(y, float) - self.y
        above = np.maximum(np.asarray(z, float), 0.0)
        depth = self.outflow_height / OUTFLOW_HEIGHT
        layer = depth / BOUNDARY_LAYER
        rate = self.outflow / (LARGEST_OUTFLOW * self.radius)
        q = (from_axis[0] ** 2 + from_axis[1] ** 2) / self.radius**2
        # (1 - exp(-q)) / q without the loss of digits on the axis, where it is 1
        radial = np.divide(-np.expm1(-q), q, out=np.ones_like(q), where=q > 1e-300)
        shape = np.exp(-above / depth) - np.exp(-above / layer)
        down = layer * np.expm1(-above / layer) - depth * np.expm1(-above / depth)
        wind = np.broadcast_arrays(
            *(rate / 2 * d * radial * shape for d in from_axis),
            -rate * np.exp(-q) * down,
            np.asarray(time, float),
        )
        return wind[0], wind[1], wind[2]
