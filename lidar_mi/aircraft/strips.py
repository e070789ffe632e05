"""Forces and moments of the wake's wind on wing and tail, by strip theory.

Every strip of a surface meets the wind as if it were alone: its force along the normal is
q S_i a w_n / V, with the dynamic pressure q, the strip's area S_i, the airspeed V, the wind w_n
along the normal and a lift slope a that accounts for the finite span. On an elliptic wing,
Prandtl's lifting line has the slope a0 / (1 + n a0 / (pi A)) for the n-th mode of the loading, A
the aspect ratio and a0 the slope of the sections (Glauert 1926). Lift is the first mode, rolling
moment the second, so that strips with n = 1 for forces and n = 2 for rolling moments have the lift
and the rolling moment of the lifting line in any wind; the aspect ratio of n = 2 is that of one
half of the wing (Barrows 1977).

Neglected: sweep, the fuselage, and the forces in a surface's plane. Unsteady lift, stall and wind
along the path are of `strip_loads`.

Body frame: x forward, y left, z up, from the centre of gravity.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

STRIPS = 40

TAIL_ASPECT_RATIO, FIN_ASPECT_RATIO = 4.0, 1.6
"""Usual for transport aircraft (Raymer 2018, table 4.3)."""


@dataclass(frozen=True, eq=False)
class Loads:
    """Force and moment in the body frame, about the centre of gravity.

    force (..., 3): N; of one moment or of several.
    moment (..., 3): N m, right-handed about each axis: positive with the port wing up, the nose
        down, the nose to port.
    bending (..., 2): bending moments of the port and the starboard wing at the plane of symmetry, N
        m, positive with the tip up. Default: none are known, 0.
    """

    force: np.ndarray
    moment: np.ndarray
    bending: np.ndarray = field(default_factory=lambda: np.zeros(2))


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips of lifting surfaces.

    places, normals (n, 3): of the strips' centres of pressure, m, and unit vectors along which they
        lift.
    areas (n,): m^2.
    slopes, roll_slopes (n,): lift slope of forces, and of moments about the body's x axis, per rad.
    bends (n,): strips of the wing: they bend its roots.
    chords (n,): m.
    """

    places: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    slopes: np.ndarray
    roll_slopes: np.ndarray
    bends: np.ndarray
    chords: np.ndarray


def finite_span_slope(section_slope: float, aspect_ratio: float, mode: int = 1) -> float:
    """Lift slope a0 / (1 + n a0 / (pi A)) of the n-th mode of an elliptic wing, per rad.

    Source: Glauert 1926, chapter 11, equations of the monoplane with elliptic chord.

    section_slope: a0 of the sections, per rad.
    aspect_ratio: A, squared span over area.
    mode: 1 for lift, 2 for rolling moment.
    """
    return section_slope / (1 + mode * section_slope / (np.pi * aspect_ratio))


def wing_strips(
    span: float, area: float, lift_slope: float, n: int = STRIPS, place: ArrayLike = (0.0, 0.0, 0.0)
) -> Strips:
    """A wing or horizontal tail with elliptic chord, c = 4 S / (pi b) sqrt(1 - (2 y / b)^2).

    The strips are the nodes y_k = b/2 cos(k pi / (n + 1)) of Gauss-Chebyshev quadrature of the
    second kind, whose weight is the elliptic chord: lift and moments are exact for winds that are
    polynomials in y up to the degree 2 n - 1.

    span, area: b (m) and S (m^2).
    lift_slope: of the sections, per rad.
    n: number of strips.
    place (3,): middle of the surface in the body frame, m.

    Raises InputError: span, area, slope or number not positive.
    """
    angle = _angles(n)
    places = np.tile(np.asarray(place, dtype=float), (n, 1))
    places[:, 1] += span / 2 * np.cos(angle)
    return _surface(places, (0.0, 0.0, 1.0), angle, area, lift_slope, span, area)


def fin_strips(
    height: float, area: float, lift_slope: float, n: int = STRIPS, place: ArrayLike = (0, 0, 0)
) -> Strips:
    """A vertical tail: the upper half of an elliptic wing, mirrored at its root.

    Slope and number are those of `wing_strips`; ``place`` is the root in the body frame (m).
    """
    angle = _angles(2 * n)[:n]
    places = np.tile(np.asarray(place, dtype=float), (n, 1))
    places[:, 2] += height * np.cos(angle)
    # aspect ratio of the wing whose upper half it is
    surface = _surface(places, (0.0, 1.0, 0.0), angle, area, lift_slope, 2 * height, 2 * area)
    # half a symmetric loading: its moment about the root has the slope of the force
    return replace(surface, roll_slopes=surface.slopes)


def in_downwash(tail: Strips, section_slope: float, aspect_ratio: float) -> Strips:
    """A horizontal tail in the downwash of a wing that meets the same wind.

    Far behind an elliptic wing the induced angle is twice that at the wing: the tail keeps the
    fraction 1 - 2 n a_n / (pi A) of the n-th mode, with the wing's slope a_n. The downwash has no
    delay, and that of the wind's linear parts is used for all of it. Slope and aspect ratio are the
    wing's, as in `finite_span_slope`.
    """
    fractions = [
        1 - 2 * n * finite_span_slope(section_slope, aspect_ratio, n) / (np.pi * aspect_ratio)
        for n in (1, 2)
    ]
    return replace(
        tail, slopes=fractions[0] * tail.slopes, roll_slopes=fractions[1] * tail.roll_slopes
    )


def as_wing(surface: Strips) -> Strips:
    """A surface whose loads bend the roots of the wing, at the plane of symmetry.

    Bending by wind that is uniform or linear across the span is that of the lifting line, to the
    quadrature of the kink at the root; all that both wings have in common has the slope of lift.
    """
    return replace(surface, bends=np.ones(len(surface.areas), bool))


def joined(*surfaces: Strips) -> Strips:
    """Strips of several surfaces."""
    names = ("places", "normals", "areas", "slopes", "roll_slopes", "bends", "chords")
    return Strips(
        *(np.concatenate([getattr(surface, name) for surface in surfaces]) for name in names)
    )


def wake_loads(strips: Strips, wind: ArrayLike, airspeed: float, density: float) -> Loads:
    """Force and moment of a wind (..., n, 3) at the strips, in the body frame, m/s.

    The airspeed is in m/s, the density in kg m^-3.
    """
    normal_wind = (np.asarray(wind, dtype=float) * strips.normals).sum(-1)
    pressure = (0.5 * density * airspeed) * strips.areas * normal_wind  # q S_i w_n / V
    # moments of unit forces along the normals
    arms = np.cross(strips.places, strips.normals)
    lift = pressure * strips.slopes
    moment = lift @ arms
    # the second mode of the loading, whose slope is smaller
    moment[..., 0] = (pressure * strips.roll_slopes) @ arms[:, 0]
    # what both wings have in common has the first slope, their difference the second
    across = np.where(strips.bends, strips.places[:, 1], 0.0)
    total, difference = lift @ np.abs(across), (pressure * strips.roll_slopes) @ across
    bending = np.stack([total + difference, total - difference], -1) / 2
    return Loads(lift @ strips.normals, moment, bending)


def roll_damping(strips: Strips, airspeed: float, density: float) -> float:
    """Rolling moment per roll rate of the strips, N m per rad/s, negative.

    For an elliptic wing C_lp = -a/8, with the slope a of the second mode.
    """
    wind = -np.cross([1.0, 0.0, 0.0], strips.places)  # of an aircraft that rolls at 1 rad/s
    return float(wake_loads(strips, wind, airspeed, density).moment[0])


def _angles(n: int) -> np.ndarray:
    """Angles of the nodes of the quadrature, rad, shape (n,)."""
    if n < 2:
        raise InputError(f"strips.n: {n} is not allowed; expected 2 or more")
    return np.arange(1, n + 1) * np.pi / (n + 1)


def _surface(
    places: np.ndarray,
    normal: tuple[float, float, float],
    angle: np.ndarray,
    area: float,
    lift_slope: float,
    span: float,
    whole_area: float,
) -> Strips:
    """Strips of a surface of so much area (m^2), which is part of a wing of span and whole area."""
    for name, value in (("span", span), ("area", area), ("lift_slope", lift_slope)):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"strips.{name}: {value} is not allowed; expected a number > 0")
    # the elliptic chord at each node times the distance between the nodes
    weights = np.sin(angle) ** 2
    ones = np.ones(len(places))
    aspect_ratio = span**2 / whole_area
    return Strips(
        places,
        np.tile(np.asarray(normal, dtype=float), (len(places), 1)),
        area * weights / weights.sum(),
        finite_span_slope(lift_slope, aspect_ratio) * ones,
        finite_span_slope(lift_slope, aspect_ratio, mode=2) * ones,
        np.zeros(len(places), bool),
        4 * whole_area / (np.pi * span) * np.sin(angle),
    )
