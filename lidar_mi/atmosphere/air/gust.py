"""The discrete 1-cosine gust of CS 25.341(a)."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.errors import InputError

Direction = Literal["up", "down", "left", "right"]
_TOWARDS = {"up": (2, 1), "down": (2, -1), "left": (1, 1), "right": (1, -1)}


@dataclass(frozen=True)
class Gust:
    """U/2 (1 - cos(pi s / H)) for 0 <= s <= 2 H, across the path; the same at every y and z.

    direction {"up", "down", "left", "right"}: in which it blows.
    gradient: H, m: half of its length.
    start: where it begins, along x, m.
    speed: U, the largest, m/s true airspeed.

    Raises InputError: numbers out of range, another direction.
    """

    direction: Direction
    gradient: float
    start: float
    speed: float

    def __post_init__(self) -> None:
        if self.direction not in _TOWARDS:
            raise InputError(
                f"gust.direction: {self.direction!r} is not known; expected {', '.join(_TOWARDS)}"
            )
        for name, low in (("gradient", 0.0), ("start", -math.inf), ("speed", 0.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > low):
                raise InputError(
                    f"gust.{name}: {value} is not allowed; expected "
                    f"{'a finite number' if low < 0 else 'above 0'}"
                )

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        s = (np.asarray(x, float) - self.start) / self.gradient
        inside = (s >= 0) & (s <= 2)
        profile = np.where(inside, self.speed / 2 * (1 - np.cos(np.pi * s)), 0.0)
        shape = np.broadcast_shapes(*(np.shape(a) for a in (x, y, z, time)))
        wind = np.zeros((3, *shape))
        axis, sign = _TOWARDS[self.direction]
        wind[axis] = sign * profile
        u, v, w = wind
        return u, v, w
