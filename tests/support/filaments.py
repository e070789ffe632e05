"""Filaments whose velocity is known: rings, and a pair with waves as small as one likes."""

import numpy as np

from lidar_mi.atmosphere.vortices.filaments import Curve, Filaments, node_count


def ring(radius, core_radius, model):
    """A circular ring across n, which moves along +n, alone: its images are 1e4 radii away."""
    count = node_count(2 * np.pi * radius, core_radius, model)
    angle = 2 * np.pi * np.arange(count) / count
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(count)
    places = radius * np.stack([c, s, zero], axis=1)
    steps = radius * np.stack([-s, c, zero], axis=1) * (2 * np.pi / count)
    return Filaments([Curve(places, steps)], 1e4 * radius, core_radius, model, radius)


def crow_growth(wavelength, core_radius, model):
    """Growth rate (in Gamma / 2 pi b^2) and plane (degrees) of the symmetric wave of a pair, b = 1.

    From the velocity of lines that are displaced a little, in both directions across the axis.
    """
    k, small = 2 * np.pi / wavelength, 1e-4
    count = node_count(wavelength, core_radius, model)
    s = np.arange(count) * wavelength / count

    def speed(left, up):
        curves = []
        for side in (1, -1):
            size, slope = np.sin(k * s), k * np.cos(k * s)
            places = np.stack([s, side / 2 + side * left * size, up * size], axis=1)
            steps = np.stack([np.ones(count), side * left * slope, up * slope], axis=1)
            curves.append(Curve(places, side * steps * wavelength / count))
        lines = Filaments(curves, wavelength, core_radius, model, 1.0, images=10)
        return 2 * (lines.velocity(curves[0].places)[:, 1:] * np.sin(k * s)[:, None]).mean(0)

    matrix = np.empty((2, 2))
    for column, (left, up) in enumerate(((small, 0.0), (0.0, small))):
        matrix[:, column] = (speed(left, up) - speed(-left, -up)) / (2 * small)
    rates, shapes = np.linalg.eig(2 * np.pi * matrix)
    fastest = int(np.argmax(rates.real))
    left, up = np.abs(shapes[:, fastest])
    return float(rates[fastest].real), float(np.degrees(np.arctan2(up, left)))


CUTOFFS = {"burnham_hallock": np.e / 2, "lamb_oseen": 1.44026 / np.sqrt(2 * 1.2564)}
"""Length below which Biot-Savart's integral is cut off to the same speed, over the core radius.

Its logarithm is the mean of ln r over the kernel's g'(r): ln(r_c) + 1 - ln 2 of Moore's kernel; of
Gaussian vorticity, whose g' is the density of Maxwell's distribution, ln s + (psi(3/2) + ln 2) / 2.
"""
