"""Wind that changes with the height: linearly, or as over a rough ground.

The wind is that relative to the mean wind at the height of the start.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.errors import InputError


@dataclass(frozen=True)
class LinearShear:
    """A horizontal wind that grows linearly with the height; 0 at the height of the start.

    ``du_dz`` and ``dv_dz`` are in 1/s, the height of the start in m.
    """

    du_dz: float
    dv_dz: float
    height: float

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        above = _full(np.asarray(z, float) - self.height, x, y, time)
        return self.du_dz * above, self.dv_dz * above, np.zeros_like(above)


@dataclass(frozen=True)
class LogarithmicShear:
    """The neutral surface layer: a wind of speed ln(z/z0) / ln(reference/z0), 0 below z0.

    Source: MIL-F-8785C, section 3.7.3.2, with the wind W20 at 20 ft and z0 = 0.15 ft (approach) or
    2 ft; the law is that of Prandtl and von Karman.

    speed, reference: wind (m/s) at a height (m) above the ground.
    roughness: z0, m, below the reference.
    towards: direction in which it blows, rad: 0 is a tail wind, pi/2 goes to the left.
    height: of the start, m, where the frame moves with it.

    Raises InputError: a roughness at or above the reference.
    """

    speed: float
    reference: float
    roughness: float
    towards: float
    height: float

    def __post_init__(self) -> None:
        if not 0 < self.roughness < self.reference:
            raise InputError(
                f"logarithmic_shear.roughness: {self.roughness:g} m is not allowed; expected above "
                f"0 and below the {self.reference:g} m of its reference"
            )

    def wind_at(self, height: ArrayLike) -> np.ndarray:
        """Wind of the surface layer, m/s, at heights above the ground (m)."""
        above = np.maximum(np.asarray(height, float) / self.roughness, 1.0)
        return self.speed * np.log(above) / math.log(self.reference / self.roughness)

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast."""
        relative = _full(self.wind_at(z) - self.wind_at(self.height), x, y, time)
        along, left = math.cos(self.towards), math.sin(self.towards)
        return along * relative, left * relative, np.zeros_like(relative)


def _full(values: np.ndarray, *others: ArrayLike) -> np.ndarray:
    """Values broadcast to the common shape."""
    shape = np.broadcast_shapes(values.shape, *(np.shape(a) for a in others))
    return np.broadcast_to(values, shape)
