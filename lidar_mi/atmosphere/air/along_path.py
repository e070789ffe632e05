"""All of the air of a flight: a wake, and the air that moves beside it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.atmosphere.vortices.wake_path import Components, WakeAlongPath
from lidar_mi.errors import InputError


class MovingAir(Protocol):
    """A part of the air, in the level frame of `lidar_mi.atmosphere.air`."""

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        ...


@dataclass(frozen=True)
class LevelFrame:
    """From the path frame, which climbs, to the level frame, whose z is the height.

    The path starts at an altitude above the ground (m) and climbs by an angle (rad).
    """

    altitude: float
    climb_angle: float

    def places(self, x: ArrayLike, z: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """x and z (m) in the level frame of places in the path frame."""
        c, s = math.cos(self.climb_angle), math.sin(self.climb_angle)
        x, z = np.asarray(x, float), np.asarray(z, float)
        return c * x - s * z, self.altitude + s * x + c * z

    def wind(self, parts: Sequence[MovingAir], *place_and_time: ArrayLike) -> Components:
        """u, v, w (m/s, path frame) of all parts at x, y, z (m, path frame) and times (s)."""
        x, y, z, time = place_and_time
        level_x, height = self.places(x, z)
        shape = np.broadcast_shapes(*(np.shape(a) for a in place_and_time))
        wind = np.zeros((3, *shape))
        for part in parts:
            wind += np.stack(part.velocity(level_x, y, height, time))
        c, s = math.cos(self.climb_angle), math.sin(self.climb_angle)
        u, v, w = wind
        return c * u + s * w, v, c * w - s * u


@dataclass(frozen=True, eq=False)
class AirAlongPath:
    """The sum of a wake and other air, in the path frame; a `WakeAlongPath`.

    The wake drifts as a whole. That other air bends, stretches or weakens it is neglected.

    drift: of the wake, m/s, path frame.
    t_c: when the wake is at its own place, s.
    """

    wake: WakeAlongPath | None
    parts: Sequence[MovingAir]
    frame: LevelFrame
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    t_c: float = 0.0

    def _in_the_wake(self, *place_and_time: ArrayLike) -> Components:
        """x, y, z (m) relative to the drifting wake."""
        x, y, z, time = (np.asarray(a, float) for a in place_and_time)
        along, left, up = (speed * (time - self.t_c) for speed in self.drift)
        return x - along, y - left, z - up

    def wind(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m s^-1) at places (m) and times (s), which broadcast."""
        ambient = self.frame.wind(self.parts, x, y, z, time)
        if self.wake is None:
            return ambient
        swirl = self.wake.wind(*self._in_the_wake(x, y, z, time), time)
        u, v, w = (a + b for a, b in zip(ambient, swirl, strict=True))
        return u, v, w

    def extinction(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike
    ) -> np.ndarray | None:
        """That of the wake, m^-1; None: the background everywhere."""
        if self.wake is None:
            return None
        return self.wake.extinction(*self._in_the_wake(x, y, z, time), time)

    def vortices(self, x: float, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex in the plane x at a time.

        Raises InputError: there is no wake, or it lies in the plane.
        """
        if self.wake is None:
            raise InputError("encounter.air.wake: false leaves no vortices; expected true")
        along, left, up = (speed * (time - self.t_c) for speed in self.drift)
        port, starboard = (
            replace(vortex, y=vortex.y + left, z=vortex.z + up)
            for vortex in self.wake.vortices(x - along, time)
        )
        return port, starboard
