"""A vortex pair above the ground: it sinks, spreads, drifts with the wind and decays.

Frame: x along the flight, forward; y left; z the height above the ground; y = 0 where the wake
begins.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from lidar_mi.atmosphere.vortices.vortex import Model, Vortex, angular_velocity, vortex_pair
from lidar_mi.errors import InputError

Crosswind = Callable[[np.ndarray], np.ndarray]
"""Mean wind to the left (m/s) at heights above the ground (m)."""

_TOLERANCE = 1e-8


def _calm(height: np.ndarray) -> np.ndarray:
    return np.zeros_like(height)


@dataclass(frozen=True, eq=False)
class PairAboveGround:
    """A pair of analytic vortices whose images below the ground keep air from passing it.

    Every vortex moves with the flow of the others, of all images, and with the wind at its height.
    Without wind the pair of point vortices follows 1 / y^2 + 1 / z^2 = const (Lamb, Hydrodynamics,
    section 155): it sinks to half of its separation and spreads. The boundary layer at the
    ground, whose vorticity makes real vortices rise again, is not there.

    circulation, separation, core_radius: at age 0, m^2/s and m.
    height: of both vortices at age 0, m.
    last: latest time that is asked for, s; the first is 0.
    age: at time 0, s.
    decay_time: s, in which circulation falls to 1/e.
    crosswind: `Crosswind`.
    ground: with images.

    Raises InputError: a pair that is no pair, or below the ground.
    """

    circulation: float
    separation: float
    core_radius: float
    height: float
    last: float
    age: float = 0.0
    decay_time: float | None = None
    crosswind: Crosswind = _calm
    model: Model = "lamb_oseen"
    ground: bool = True
    _path: Callable[[np.ndarray], np.ndarray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        vortex_pair(self.circulation, self.separation, self.core_radius, model=self.model)
        if not self.height > 0:
            raise InputError(f"height: {self.height} m is not allowed; expected above 0 m")
        half = self.separation / 2
        solution = solve_ivp(
            self._speeds,
            (-self.age, max(self.last, -self.age) + 1e-6),
            [half, -half, self.height, self.height],
            method="DOP853",
            rtol=_TOLERANCE,
            atol=_TOLERANCE,
            dense_output=True,
        )
        object.__setattr__(self, "_path", solution.sol)

    def _speeds(self, time: float, state: np.ndarray) -> np.ndarray:
        y, z = state[:2], state[2:]
        v, w = self._flow(y, z, np.full(2, time), y[:, None], z[:, None])
        return np.concatenate([v + self.crosswind(z), w])

    def circulation_at(self, time: ArrayLike) -> np.ndarray:
        """Circulation at a time, m^2/s."""
        passed = self.age + np.asarray(time, float)
        if self.decay_time is None:
            return np.full(passed.shape, self.circulation)
        return self.circulation * np.exp(-passed / self.decay_time)

    def places(self, time: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """y and z (2, ...) of the port and the starboard vortex at times, m."""
        time = np.asarray(time, float)
        # lines hold a time for all of their gates
        moments, index = np.unique(time, return_inverse=True)
        states = self._path(moments)[:, index.reshape(time.shape)]
        return states[:2], states[2:]

    def vortices(self, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex at a time."""
        (left, right), (high, low) = self.places(time)
        strength = float(self.circulation_at(time))
        return (
            Vortex(strength, self.core_radius, float(left), float(high), self.model),
            Vortex(-strength, self.core_radius, float(right), float(low), self.model),
        )

    def wind(self, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """v and w of the vortices and images (m/s) at places (m) and times (s), which broadcast."""
        y, z, time = np.broadcast_arrays(*(np.asarray(a, float) for a in (y, z, time)))
        return self._flow(y, z, time, *self.places(time))

    def _flow(
        self, y: np.ndarray, z: np.ndarray, time: np.ndarray, left: np.ndarray, up: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        strength = self.circulation_at(time)
        v, w = np.zeros(y.shape), np.zeros(y.shape)
        for sign, y0, z0 in zip((1, -1), left, up, strict=True):
            for mirrored in (False, True)[: 1 + self.ground]:
                # an image turns the other way
                turn = -sign if mirrored else sign
                dy, dz = y - y0, z + z0 if mirrored else z - z0
                omega = turn * angular_velocity(
                    dy**2 + dz**2, strength, self.core_radius, self.model
                )
                v, w = v - omega * dz, w + omega * dy
        return v, w
