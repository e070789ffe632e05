"""Loads of a wake by strip theory against closed forms and a lattice of horseshoe vortices."""

import numpy as np
from scipy.special import ive

from lidar_mi.aircraft.strips import roll_damping, wake_loads, wing_strips
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity

from .report import Check, Row

TITLE = "Wake encounters"
INTRODUCTION = (
    "Lift and rolling moment of a wing with elliptic chord in the wind of a vortex, from the "
    "default strips of `lidar_mi.aircraft.strips`. The wing is that of a Boeing 737 in air of "
    "1.2 kg/m3 at 75 m/s, its sections have the slope 5.3."
)

SPAN, AREA, SLOPE = 28.9, 108.8, 5.3
AIRSPEED, DENSITY = 75.0, 1.2
PRESSURE = 0.5 * DENSITY * AIRSPEED**2
ASPECT_RATIO = SPAN**2 / AREA
CIRCULATION = 350.0


def coefficients(wind_of, **surface):
    """C_L and C_l by strips, in a vertical wind (m/s) along the span."""
    strips = wing_strips(SPAN, AREA, SLOPE, **surface)
    wind = np.zeros((len(strips.areas), 3))
    wind[:, 2] = wind_of(strips.places[:, 1])
    loads = wake_loads(strips, wind, AIRSPEED, DENSITY)
    scale = PRESSURE * AREA
    return loads.force[2] / scale, loads.moment[0] / scale / SPAN


def upward(vortex):
    return lambda y: velocity([vortex], y, np.zeros_like(y))[1]


def lattice(wind_of, count=800):
    """C_L and C_l of the lifting line from horseshoe vortices, edges at b/2 cos(k pi / count).

    Of each, Gamma = V c a0 / 2 (angle of the wind - downwash / V), downwash by Biot-Savart.
    """
    angle = np.pi * np.arange(count + 1) / count
    edges = -SPAN / 2 * np.cos(angle)
    theta = (angle[1:] + angle[:-1]) / 2
    middle, chord = -SPAN / 2 * np.cos(theta), 4 * AREA / (np.pi * SPAN) * np.sin(theta)
    trailing = 1 / (middle[:, None] - edges)
    downwash = (trailing[:, :-1] - trailing[:, 1:]) / (4 * np.pi)
    matrix = np.eye(count) + 0.5 * SLOPE * chord[:, None] * downwash
    gamma = np.linalg.solve(matrix, 0.5 * SLOPE * chord * wind_of(middle))
    lift = DENSITY * AIRSPEED * gamma * np.diff(edges)
    scale = PRESSURE * AREA
    return lift.sum() / scale, (lift * middle).sum() / scale / SPAN


def on_the_axis(effort):
    """Rolling moment of a wing whose middle is on the axis."""
    slope = SLOPE / (1 + 2 * SLOPE / (np.pi * ASPECT_RATIO))
    point = slope * CIRCULATION / (2 * np.pi * AIRSPEED * SPAN)
    rows = []
    for model, radius in (
        ("burnham_hallock", 1e-6),
        ("burnham_hallock", 1.0),
        ("burnham_hallock", 3.0),
        ("burnham_hallock", 8.0),
        ("lamb_oseen", 1.0),
        ("lamb_oseen", 3.0),
        ("lamb_oseen", 8.0),
    ):
        e = 2 * radius / SPAN
        k = 1.2564 / e**2
        factor = {
            "burnham_hallock": 1 + 2 * e**2 - 2 * e * np.sqrt(1 + e**2),
            "lamb_oseen": 1 - ive(0, k / 2) - ive(1, k / 2),
        }[model]
        rows.append(
            Row(
                f"C_l, {model.replace('_', '-').title()}, core of {radius:g} m",
                "integral over the chord",
                point * factor,
                coefficients(upward(Vortex(CIRCULATION, radius, 0.0, 0.0, model)))[1],
                # what 40 strips resolve of a core of 1 m
                tolerance=(2e-3 if radius == 1.0 else 1e-6) * point * factor,
            )
        )
    return Check(
        "On the axis of a vortex",
        "Rolling moment coefficient for 350 m2/s. The chord is elliptic, so that the integral of "
        "its product with the swirl is elementary (Burnham-Hallock, with a core of 1e-6 m a point "
        "vortex) or has Bessel functions (Lamb-Oseen).",
        tuple(rows),
    )


def lifting_line(effort):
    """Strips with a slope for each mode against a lattice that knows no modes."""
    rows = []
    for y, z in ((1.0, 0.5), (5.0, 2.0), (14.45, -1.0), (-23.5, 3.0)):
        wind = upward(Vortex(CIRCULATION, 3.0, y, z))
        for name, expected, got in zip(
            ("C_L", "C_l"), lattice(wind), coefficients(wind), strict=True
        ):
            rows.append(
                Row(
                    f"{name}, axis at y = {y:g} m, z = {z:g} m",
                    "800 horseshoe vortices",
                    expected,
                    got,
                    tolerance=2e-5,
                )
            )
    return Check(
        "Lifting line",
        "A Lamb-Oseen vortex of 350 m2/s with a core of 3 m at different places. The reference is "
        "Prandtl's lifting line, solved by a lattice of horseshoe vortices. Lift and rolling "
        "moment need lift slopes of their own (modes 1 and 2 of the loading) to agree with it.",
        tuple(rows),
    )


def gust_and_roll(effort):
    """Uniform gust, roll damping."""
    rows = [
        Row(
            "C_L in a gust of 1 m/s",
            "Prandtl: a0 / (1 + a0 / (pi A)) w / V",
            SLOPE / (1 + SLOPE / (np.pi * ASPECT_RATIO)) / AIRSPEED,
            coefficients(np.ones_like)[0],
            tolerance=1e-9,
        )
    ]
    for ratio in (4.0, 8.0):
        area = SPAN**2 / ratio
        strips = wing_strips(SPAN, area, 2 * np.pi)
        scale = PRESSURE * area * SPAN**2 / (2 * AIRSPEED)
        rows.append(
            Row(
                f"C_lp, aspect ratio {ratio:g}, slope 2 pi",
                "lifting line: -(pi / 4) A / (A + 4)",
                -np.pi / 4 * ratio / (ratio + 4),
                roll_damping(strips, AIRSPEED, DENSITY) / scale,
                tolerance=1e-9,
            )
        )
    return Check(
        "Gust and roll",
        "Lift in a uniform upward wind and the damping of a rolling wing.",
        tuple(rows),
    )


CHECKS = (on_the_axis, lifting_line, gust_and_roll)
