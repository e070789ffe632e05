"""A wake along a flight path: oblique, descending, decaying, deformed.

Path frame: x along the straight flight path, forward; y left; z up, across the path; origin where
the aircraft is at time 0. The wake's axis is level while the path climbs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.vortex import (
    Model,
    Vortex,
    angular_velocity,
    tangential_speed,
    vortex_pair,
)
from lidar_mi.errors import InputError

CROW_WAVELENGTH = 8.6
"""Wavelength of the most amplified long wave, in separations (Crow, AIAA J. 8, 1970)."""

# Cosine of the steepest angle between wake and path at which a plane across the path still cuts
# both vortices: 89.4 degrees.
_LEAST_ALONG = 0.01

Components = tuple[np.ndarray, np.ndarray, np.ndarray]


class WakeAlongPath(Protocol):
    """What a flight meets: the wind anywhere at any time, and the vortices in any plane."""

    def wind(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m s^-1) at places (m, path frame) and times (s), which broadcast."""
        ...

    def extinction(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike
    ) -> np.ndarray | None:
        """Aerosol and exhaust without texture, m^-1; None: the background everywhere."""
        ...

    def vortices(self, x: float, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex in the plane x at a time."""
        ...


def wake_axes(
    crossing_angle: float, climb_angle: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors along a wake, across it to the left and upwards, in the path frame; rad."""
    c, s = math.cos(crossing_angle), math.sin(crossing_angle)
    level, up = math.cos(climb_angle), math.sin(climb_angle)
    # the wake is level: its axis falls in the frame of a climbing path
    return (
        np.array([c * level, s, -c * up]),
        np.array([-s * level, c, s * up]),
        np.array([up, 0.0, level]),
    )


def cut_radius(core_radius: float, tangent: np.ndarray) -> float:
    """Radius of the circle with the area of the ellipse that a plane across x cuts from a core."""
    return core_radius / math.sqrt(abs(tangent[0]) / float(np.linalg.norm(tangent)))


def check_cut(along: np.ndarray, crossing_angle: float) -> None:
    """Whether planes across the path cut a wake with this axis.

    Raises InputError: a wake that lies in the plane.
    """
    if along[0] < _LEAST_ALONG:
        raise InputError(
            f"path.crossing_angle: {math.degrees(crossing_angle):.4g} deg is not allowed "
            "for vortices in a plane across the path, which does not cut them; expected less "
            f"than {math.degrees(math.acos(_LEAST_ALONG)):.4g} deg"
        )


@dataclass(frozen=True)
class PairAlongPath:
    """A pair of analytic vortices along an axis that crosses the flight path.

    Both vortices are parallel to the wake's axis, which is level and turned by ``crossing_angle``
    from the path's horizontal projection; the path climbs by ``climb_angle``. So the axis has the
    slopes dz/dx = -tan(climb_angle) and dy/dx = tan(crossing_angle) / cos(climb_angle). The pair
    descends by its mutual induction and drifts with the mean wind.

    circulation: m^2 s^-1, > 0, at age 0.
    separation, core_radius: m, across the wake's axis.
    model {"lamb_oseen", "burnham_hallock"}
    crossing_angle, climb_angle: rad; the first from 0 to pi/2, positive: the wake's axis goes to
        the left ahead.
    x_c, t_c: where along the path (m) and when (s) the centre of the pair is met.
    miss: y and z (m) of the centre of the pair from the path, at x_c and t_c.
    mean_wind: v and w, m s^-1.
    decay_time: s, in which the circulation falls to 1/e.
    crow_amplitude, crow_wavelength: m; by default no deformation, and 8.6 separations. Each vortex
        is displaced by amplitude times a sine along the axis, in planes inclined by 45 degrees, the
        direction in which the partner's strain stretches it: outward and up, inward and down (Crow
        1970, in the limit of long waves). The sine moves with the pair and does not grow.
    crow_phase: of the sine at the wake's centre, rad.
    age: at time 0, s.

    Notes
    -----
    The flow of a deformed vortex at a place is that of the straight line that touches it at the
    nearest place of its mean axis. It lacks the self-induction of the curved line, of first order
    in the amplitude, and the difference of the partner's curvature: at a separation of 47 m and 8.6
    separations, 9 m and more from the cores, the velocity differs from that of the curved lines
    (Biot-Savart) by 5 % at most of what the deformation changes, 0.3, 0.7 and 1.3 % of the largest
    swirl for amplitudes of 2, 5 and 10 m.
    """

    circulation: float
    separation: float = 47.1
    core_radius: float = 3.0
    model: Model = "lamb_oseen"
    crossing_angle: float = 0.0
    climb_angle: float = 0.0
    x_c: float = 0.0
    t_c: float = 0.0
    miss: tuple[float, float] = (0.0, 0.0)
    mean_wind: tuple[float, float] = (0.0, 0.0)
    decay_time: float | None = None
    crow_amplitude: float = 0.0
    crow_wavelength: float | None = None
    crow_phase: float = 0.0
    age: float = 0.0

    def __post_init__(self) -> None:
        vortex_pair(self.circulation, self.separation, self.core_radius, model=self.model)
        for name, low, high, unit in (
            ("crossing_angle", 0.0, math.pi / 2, "rad"),
            ("climb_angle", -1.5, 1.5, "rad"),
            ("x_c", -math.inf, math.inf, "m"),
            ("t_c", -math.inf, math.inf, "s"),
            ("crow_amplitude", 0.0, self.separation / 2, "m"),
        ):
            value = getattr(self, name)
            # angles are converted from degrees, with rounding
            if not (math.isfinite(value) and low - 1e-9 <= value <= high + 1e-5):
                raise InputError(
                    f"wake along path.{name}: {value} {unit} is not allowed; expected "
                    f"{low:g} to {high:.5g} {unit}"
                )
        for name in ("decay_time", "crow_wavelength"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(
                    f"wake along path.{name}: {value} is not allowed; expected above 0"
                )

    @cached_property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors along the wake, across it to the left and upwards, in the path frame."""
        return wake_axes(self.crossing_angle, self.climb_angle)

    def circulation_at(self, time: ArrayLike) -> np.ndarray:
        """Circulation at a time, m^2 s^-1."""
        time = np.asarray(time, float)
        if self.decay_time is None:
            return np.full(time.shape, self.circulation)
        return self.circulation * np.exp(-(self.age + time) / self.decay_time)

    def centre_at(self, time: ArrayLike) -> Components:
        """x, y, z (m) at a time of the point that is at x_c and ``miss`` at t_c."""
        time = np.asarray(time, float)
        # height above that of the arrival: the integral of the descent speed
        speed = tangential_speed(self.separation, self.circulation, self.core_radius, self.model)
        if self.decay_time is None:
            above = speed * (self.t_c - time)
        else:
            ages = (self.age + time, self.age + self.t_c)
            now, at_arrival = (np.exp(-np.asarray(age) / self.decay_time) for age in ages)
            above = speed * self.decay_time * (now - at_arrival)
        arrival, wind = (self.x_c, *self.miss), (0.0, *self.mean_wind)
        x, y, z = (
            place + speed * (time - self.t_c) + axis * above
            for place, speed, axis in zip(arrival, wind, self.axes[2], strict=True)
        )
        return x, y, z

    def wind(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m s^-1) at places (m) and times (s), which broadcast."""
        along, left, _ = self.axes
        centre, strength = self.centre_at(time), self.circulation_at(time)
        place = [np.asarray(a, float) - c for a, c in zip((x, y, z), centre, strict=True)]
        shape = np.broadcast_shapes(*(a.shape for a in place))
        u, v, w = np.zeros(shape), *(np.full(shape, mean) for mean in self.mean_wind)
        for side in (1, -1):
            d = [a - side * self.separation / 2 * axis for a, axis in zip(place, left, strict=True)]
            tangent: tuple[np.ndarray, ...] = tuple(along)
            if self.crow_amplitude:
                s = _dot(d, along)
                offset, slope = self._deformation(s, side)
                # relative to the deformed line at the same place along its mean axis
                d = [a - s * b - c for a, b, c in zip(d, along, offset, strict=True)]
                length = np.sqrt(1 + slope[3] ** 2)
                tangent = tuple((a + b) / length for a, b in zip(along, slope[:3], strict=True))
            axial = _dot(d, tangent)
            # rounding can make it negative
            r2 = np.maximum(d[0] ** 2 + d[1] ** 2 + d[2] ** 2 - axial**2, 0.0)
            omega = angular_velocity(r2, side * strength, self.core_radius, self.model)
            # omega times the vector product of tangent and distance
            u = u + omega * (tangent[1] * d[2] - tangent[2] * d[1])
            v = v + omega * (tangent[2] * d[0] - tangent[0] * d[2])
            w = w + omega * (tangent[0] * d[1] - tangent[1] * d[0])
        return u, v, w

    def extinction(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> None:
        """None: analytic vortices have the background everywhere."""

    def vortices(self, x: float, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex in the plane x at a time.

        Their places are where the axes cross the plane. The circulation through the plane is that
        across the axis (Stokes); the core, an ellipse there, is given by the circle of its area.

        Raises InputError: a wake that lies in the plane.
        """
        along, left, _ = self.axes
        check_cut(along, self.crossing_angle)
        centre, strength = np.array(self.centre_at(time)), float(self.circulation_at(time))
        vortices = []
        for side in (1, -1):
            start = centre + side * self.separation / 2 * left
            offset, slope = np.zeros(3), np.zeros(3)
            axial = (x - start[0]) / along[0]
            if self.crow_amplitude:
                # by Newton's method: the offset moves the crossing by a fraction of the slope
                for _ in range(20):
                    shift, rise = self._deformation(np.asarray(axial), side)
                    offset, slope = np.array(shift, float), np.array(rise[:3], float)
                    miss = start[0] + axial * along[0] + offset[0] - x
                    axial -= miss / (along[0] + slope[0])
            _, y, z = start + axial * along + offset
            radius = cut_radius(self.core_radius, along + slope)
            vortices.append(Vortex(side * strength, radius, float(y), float(z), self.model))
        return vortices[0], vortices[1]

    def _deformation(
        self, axial: np.ndarray, side: int
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Offset (x, y, z) of a vortex at a place along its mean axis; its slopes (x, y, z), size.

        The last slope is the rate of the offset along its own direction.
        """
        _, left, up = self.axes
        wavelength = self.crow_wavelength or CROW_WAVELENGTH * self.separation
        # both planes are inclined by 45 degrees, mirror images (Crow 1970)
        inclined = (side * left + up) / math.sqrt(2)
        k = 2 * math.pi / wavelength
        size = self.crow_amplitude * np.sin(k * axial + self.crow_phase)
        rate = self.crow_amplitude * k * np.cos(k * axial + self.crow_phase)
        return [size * axis for axis in inclined], [*(rate * axis for axis in inclined), rate]


def _dot(first: Sequence[np.ndarray], second: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
