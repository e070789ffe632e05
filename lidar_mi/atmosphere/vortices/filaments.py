"""Vortex filaments that repeat along an axis: the velocity by Biot-Savart's law with a core.

Axes: s along the wake, l to the left, n up; m. Circulation 1 m^2/s throughout.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from lidar_mi.atmosphere.vortices.vortex import LAMB_OSEEN_CONSTANT, Model

# Spacing of nodes over the core radius. The rule of trapezoids is wrong by 2 exp(-2 pi^2 s^2/h^2)
# for Gaussian vorticity of the standard deviation s = 0.63 r_c, and by 4 exp(-2 pi r_c/h) for the
# algebraic kernel: 4e-6 and 1e-5.
_SPACING = {"lamb_oseen": 0.8, "burnham_hallock": 0.5}
# Distance in standard deviations from which on a Gaussian's induction is that of a point: 2e-6.
_FAR = 5.5
# Nodes per curve and period a quarter of a period away or more: wrong by exp(-2 pi 32/4).
_COARSE = 32
# Elements of a temporary array: caches hold several.
_CHUNK = 20_000


@dataclass(frozen=True, eq=False)
class Curve:
    """One closed or endless line of a period, in the direction of its vorticity.

    places (n, 3): nodes, m, at equal steps of a smooth periodic parameter.
    steps (n, 3): derivative of the place by the parameter, times its step, m.
    """

    places: np.ndarray
    steps: np.ndarray


@dataclass(frozen=True, eq=False)
class Filaments:
    """Lines of circulation 1 m^2/s, repeated along s, with a core.

    The velocity is Biot-Savart's integral with a kernel that is finite on the line,
    (1/4 pi) int dl x r g(r) / r^3: g = r^3/(r^2 + r_c^2)^(3/2) (Rosenhead 1930, Moore 1972) has the
    Burnham-Hallock swirl about an endless straight line exactly, and vorticity spread by a Gaussian
    in three dimensions, g = erf(r/(2^(1/2) s)) - (2/pi)^(1/2) (r/s) exp(-r^2/2s^2) with
    s = r_c/(2 * 1.2564)^(1/2) (Leonard 1985), that of Lamb-Oseen. Both are free of divergence.

    curves: of one period. Together they have no circulation in planes across s.
    period: m.
    core_radius: of the straight vortex: radius of the largest tangential speed, m.
    model {"lamb_oseen", "burnham_hallock"}
    separation: m. The lines beyond the images are those of a straight pair of this separation,
        whose impulse they have: separation times period is the area of the curves as seen from
        above.
    images: periods on each side of the nearest one.
    """

    curves: Sequence[Curve]
    period: float
    core_radius: float
    model: Model
    separation: float
    images: int = 2

    def velocity(self, places: np.ndarray) -> np.ndarray:
        """Velocity, m/s, at places (..., 3), m; the same shape."""
        flat = np.asarray(places, float).reshape(-1, 3)
        nodes, steps = (
            np.concatenate([getattr(curve, name) for curve in self.curves])
            for name in ("places", "steps")
        )
        far_nodes, far_steps = (
            np.concatenate(parts) for parts in zip(*map(_coarse, self.curves), strict=True)
        )
        wind = self._straight(flat)
        shifts = [j * self.period for j in range(-self.images, self.images + 1)]
        size = max(1, _CHUNK // len(nodes))
        for first in range(0, len(flat), size):
            chunk = flat[first : first + size]
            # the core matters only near a line; neighbouring points are far from most nodes
            near = self._within(chunk, nodes, _FAR * self._sigma)
            wind[first : first + size] += (
                self._sum(chunk, nodes[near], steps[near], [0.0], self._kernel, self._nearby)
                + self._sum(chunk, nodes[~near], steps[~near], [0.0], self._far, self._nearby)
                + self._sum(chunk, far_nodes, far_steps, shifts, self._far, self._beyond)
            )
        return wind.reshape(np.shape(places))

    @property
    def _sigma(self) -> float:
        """Standard deviation of the vorticity of Lamb-Oseen's vortex, m."""
        return self.core_radius / math.sqrt(2 * LAMB_OSEEN_CONSTANT)

    def _within(self, places: np.ndarray, nodes: np.ndarray, reach: float) -> np.ndarray:
        """Whether nodes are within a distance (m) of the box that holds the places."""
        low, high = places.min(0), places.max(0)
        away = np.abs(nodes - (low + high) / 2)
        away[:, 0] = np.abs(away[:, 0] - self.period * np.rint(away[:, 0] / self.period))
        return (away <= (high - low) / 2 + reach).all(1)

    def _sum(
        self,
        places: np.ndarray,
        nodes: np.ndarray,
        steps: np.ndarray,
        shifts: Sequence[float],
        kernel: Callable[[np.ndarray], np.ndarray],
        part: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """Sum over nodes, each at its place nearest along s, shifted."""
        s, left, up = (places[:, None, k] - nodes[None, :, k] for k in range(3))
        s -= self.period * np.rint(s / self.period)
        across = left**2 + up**2
        plain, moment = np.zeros(s.shape), np.zeros(s.shape)
        for shift in shifts:
            moved = s + shift
            weight = part(moved) * kernel(moved**2 + across)
            plain += weight
            moment += weight * moved
        a, b, c = steps.T
        left *= plain
        up *= plain
        # dl x r, component by component, summed over the nodes
        u, v, w = up @ b - left @ c, moment @ c - up @ a, left @ a - moment @ b
        return np.stack([u, v, w], axis=1) / (4 * np.pi)

    def _nearby(self, s: np.ndarray) -> np.ndarray:
        """Weight of the fine nodes at the distance s along the axis.

        1 up to a quarter of a period, 0 from half of it on: a sum with a sharp end would depend on
        the place of its last node.
        """
        ramp = np.clip(4 * np.abs(s) / self.period - 1, 0.0, 1.0)
        return np.cos(np.pi / 2 * ramp) ** 2

    def _beyond(self, s: np.ndarray) -> np.ndarray:
        """Weight of the coarse nodes."""
        return 1 - self._nearby(s)

    def _far(self, r2: np.ndarray) -> np.ndarray:
        """g(r) / r^3 (m^-3) beyond the reach of the core; r2 in m^2."""
        if self.model == "burnham_hallock":
            r2 = r2 + self.core_radius**2
        else:
            # nearer ones have no weight: any finite value will do
            r2 = np.maximum(r2, self._sigma**2)
        return 1 / (r2 * np.sqrt(r2))

    def _kernel(self, r2: np.ndarray) -> np.ndarray:
        """g(r) / r^3 (m^-3) anywhere; r2 in m^2."""
        if self.model == "burnham_hallock":
            return self._far(r2)
        x2 = r2 / self._sigma**2
        x = np.sqrt(x2)
        g = scipy.special.erf(x / math.sqrt(2)) - math.sqrt(2 / np.pi) * x * np.exp(-x2 / 2)
        # near the centre the difference of both terms loses its digits
        series = math.sqrt(2 / np.pi) * (1 / 3 - x2 / 10)
        small = x < 0.02
        return np.where(small, series, g / np.where(small, 1.0, x2 * x)) / self._sigma**3

    def _straight(self, places: np.ndarray) -> np.ndarray:
        """Velocity by a straight pair beyond the images."""
        reach, wind = (self.images + 0.5) * self.period, np.zeros((len(places), 3))
        for side in (1, -1):
            left, up = places[:, 1] - side * self.separation / 2, places[:, 2]
            far = np.sqrt(reach**2 + left**2 + up**2)
            # omega of an endless line, less that of its part within reach
            omega = side / (2 * np.pi * far * (far + reach))
            wind[:, 1] -= omega * up
            wind[:, 2] += omega * left
        return wind

    @cached_property
    def drift(self) -> np.ndarray:
        """Mean velocity (3,) of the lines per length along s, m/s."""
        mean = np.zeros(3)
        weight = 0.0
        for curve in self.curves:
            along = np.abs(curve.steps[:, 0])
            mean += along @ self.velocity(curve.places)
            weight += along.sum()
        return mean / weight


def node_count(length: float, core_radius: float, model: Model) -> int:
    """Nodes of a curve that is ``length`` (m) long, at its largest speed by its parameter."""
    return _COARSE * math.ceil(length / (_SPACING[model] * core_radius * _COARSE))


def _coarse(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and steps of an image."""
    stride = len(curve.places) // _COARSE
    return curve.places[::stride], stride * curve.steps[::stride]
