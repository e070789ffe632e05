"""Crow's instability of a vortex pair: growth of its long waves, linking, and the rings after it.

Axes: s along the wake, l to the left, n up, from the middle of the pair; m.
"""

import math

import numpy as np

from lidar_mi.atmosphere.vortices.filaments import Curve, Filaments, node_count
from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.errors import InputError

GROWTH = 0.83
"""Largest growth rate times `time_scale` (Crow, AIAA J. 8, 2172-2179, 1970)."""

PLANE = math.radians(48.0)
"""Inclination of the planes of the fastest wave (Crow 1970)."""

# Length of a ring over the wavelength: a choice, as rings swing. Neighbours touch at 1; at 0.8 and
# 0.97 the largest rolling moment of crossings at 10 degrees is 14 and 6 % larger.
_RING_LENGTH = 0.9


def time_scale(circulation: float, separation: float) -> float:
    """Time 2 pi b^2 / Gamma in which a pair sinks by its separation, s."""
    return 2 * math.pi * separation**2 / circulation


def linking_amplitude(separation: float) -> float:
    """Amplitude at which the troughs of both lines touch, m."""
    return separation / (2 * math.cos(PLANE))


def linking_age(amplitude: float, circulation: float, separation: float) -> float:
    """Age at which a wave of this amplitude (m) at age 0 links the vortices, s.

    Growth is exponential until then, as of Crow and Bate (J. Aircraft 13, 476-482, 1976).
    """
    scale = time_scale(circulation, separation)
    return scale / GROWTH * math.log(linking_amplitude(separation) / amplitude)


def grown(amplitude: float, age: float, circulation: float, separation: float) -> float:
    """Amplitude (m) at an age (s): the fastest wave in the circulation at age 0."""
    return amplitude * math.exp(GROWTH * age / time_scale(circulation, separation))


def crow_filaments(
    amplitude: float,
    separation: float,
    wavelength: float,
    core_radius: float,
    model: Model = "lamb_oseen",
    phase: float = 0.0,
) -> Filaments:
    """Lines of a pair with a wave of this amplitude; rings from the amplitude of linking on.

    Below it both lines are displaced by a sine in planes inclined by 48 degrees, outward and up,
    inward and down. Linked, each wave is a ring: an ellipse as seen from above, 0.9 wavelengths
    long, as high as the wave at linking, with its ends down, as the waves had their troughs. It has
    the circulation of the lines, and as seen from above the area that was between them, so that the
    impulse is conserved (Saffman 1992, section 3.2). It keeps this shape: real rings swing between
    long and wide (Dhanak and de Bernardinis, J. Fluid Mech. 109, 189-216, 1981).

    amplitude: m, >= 0.
    separation, wavelength, core_radius: m.
    model {"lamb_oseen", "burnham_hallock"}
    phase: of the sine at s = 0, rad; rings have their middles where the sine is 1.

    Raises InputError: a wave shorter than the separation, cores that are not thin.
    """
    if wavelength < separation:
        raise InputError(
            f"crow.wavelength: {wavelength:g} m is not allowed; expected at least the separation, "
            f"{separation:g} m"
        )
    if core_radius > separation / 4:
        raise InputError(
            f"crow: filaments with a core radius of {core_radius:g} m are not allowed; expected at "
            f"most a quarter of the separation, {separation / 4:g} m"
        )
    linked = linking_amplitude(separation)
    curves = (
        [_line(side, amplitude, separation, wavelength, core_radius, model) for side in (1, -1)]
        if amplitude < linked
        else [_ring(linked, separation, wavelength, core_radius, model)]
    )
    shift = np.array([-phase / (2 * math.pi) * wavelength, 0.0, 0.0])
    moved = [Curve(curve.places + shift, curve.steps) for curve in curves]
    return Filaments(moved, wavelength, core_radius, model, separation)


def _line(
    side: int, amplitude: float, separation: float, wavelength: float, radius: float, model: Model
) -> Curve:
    k = 2 * math.pi / wavelength
    longest = wavelength * math.sqrt(1 + (amplitude * k) ** 2)
    count = node_count(longest, radius, model)
    s = np.arange(count) * (wavelength / count)
    size, slope = amplitude * np.sin(k * s), amplitude * k * np.cos(k * s)
    left, up = side * math.cos(PLANE), math.sin(PLANE)
    places = np.stack([s, side * separation / 2 + left * size, up * size], axis=1)
    tangent = np.stack([np.ones(count), left * slope, up * slope], axis=1)
    # the port vortex turns about +s, the starboard one about -s
    return Curve(places, side * tangent * (wavelength / count))


def _ring(
    linked: float, separation: float, wavelength: float, radius: float, model: Model
) -> Curve:
    half, height = _RING_LENGTH * wavelength / 2, linked * math.sin(PLANE)
    wide = separation * wavelength / (math.pi * half)
    longest = 2 * math.pi * max(half, math.hypot(wide, 2 * height))
    count = node_count(longest, radius, model)
    angle = 2 * math.pi * np.arange(count) / count
    c, s = np.cos(angle), np.sin(angle)
    # the sine is 1 at a quarter of the wave; the port half, l > 0, runs along +s
    places = np.stack([wavelength / 4 - half * c, wide * s, -height * np.cos(2 * angle)], axis=1)
    tangent = np.stack([half * s, wide * c, 2 * height * np.sin(2 * angle)], axis=1)
    return Curve(places, tangent * (2 * math.pi / count))
