"""A real lens with the mapping of an ideal one: an aspheric singlet of fused silica.

The lens in front of a fringe camera has one task: light at the angle theta must fall f tan(theta)
from the axis, all of it. One piece of glass can: the conic constant of its front removes spherical
aberration, the ratio of its curvatures coma, a stop at the lens distortion (Welford 1986,
Aberrations of Optical Systems, chap. 8). Curvature of field and astigmatism are left: they blur the
corners, evenly to all sides.
"""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

# thickness, and distance of the stop from the front, in focal lengths
THICKNESS = 0.02
STOP_DISTANCE = 1 / 300


def fused_silica_index(wavelength: float) -> float:
    """Refractive index of fused silica at 20 C (Malitson 1965, J. Opt. Soc. Am. 55, 1205).

    The wavelength (m) is 0.21 to 3.71 um.
    """
    if not 0.21e-6 <= wavelength <= 3.71e-6:
        raise InputError(f"wavelength: {wavelength:g} m is not allowed; expected 0.21 to 3.71 um")
    square = (wavelength * 1e6) ** 2
    strengths = np.array([0.6961663, 0.4079426, 0.8974794])
    resonances = np.array([0.0684043, 0.1162414, 9.896161])
    return float(np.sqrt(1 + (strengths * square / (square - resonances**2)).sum()))


def singlet(focal_length: float, wavelength: float, stop_radius: float, field: float) -> np.ndarray:
    """An aspheric singlet without spherical aberration, coma and distortion.

    focal_length: m.
    wavelength: m.
    stop_radius: of the light, m; at most 0.1 focal lengths.
    field: half angle of the corrected image, rad; at most 0.05.

    Returns
    -------
    array (3, 4)
        Rows for the stop and both surfaces: radius of curvature (0: plane), conic constant,
        distance to the next row or the CCD, refractive index behind; m.

    Notes
    -----
    For 300 mm, 5 mm and the corners of the default camera (15 mrad) the middle of the light stays
    within 0.002 pixels of f tan(theta); its rms width grows with the square of the angle to 0.16
    pixels (0.14 radially, 0.07 across) in the corners. The width is proportional to the stop.
    """
    for name, value, most in (
        ("focal_length", focal_length, np.inf),
        ("stop_radius", stop_radius, 0.1 * focal_length),
        ("field", field, 0.05),
    ):
        if not (0 < value <= most and np.isfinite(value)):
            raise InputError(f"{name}: {value:g} is not allowed; expected above 0, up to {most:g}")
    index = fused_silica_index(wavelength)
    zone, spoke = (0.2 + np.arange(5)) / 5, np.pi * (0.5 + np.arange(6)) / 6
    height = stop_radius / focal_length * np.sqrt(zone)[:, None]
    pupil = (height * np.cos(spoke)).ravel(), (height * np.sin(spoke)).ravel()
    angles = field * np.linspace(0, 1, 5)[1:]

    def lens(shape: np.ndarray) -> np.ndarray:
        front, back, conic, distance = shape
        return np.array(
            [
                [0, 0, STOP_DISTANCE, 1],
                [1 / front, conic, THICKNESS, index],
                [1 / back, 0, distance, 1],
            ]
        )

    def aberrations(shape: np.ndarray) -> np.ndarray:
        across, along = trace(lens(shape), *pupil, 0.0)
        residuals = [across, along]  # of light on the axis: spherical aberration, focus
        for angle in angles:
            place, _ = trace(lens(shape), *pupil, angle)
            rings = place.reshape(len(zone), -1).mean(1)  # coma moves them, blur does not
            residuals.append(rings - np.tan(angle))
        return np.concatenate(residuals)

    power = 1 / (index - 1)
    solved = scipy.optimize.least_squares(
        aberrations,
        [0.85 * power, -0.15 * power, -0.5, 1.0],
        x_scale=[1, 1, 1, 0.01],
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    return lens(solved.x) * np.array([focal_length, 1, focal_length, 1])


def trace(
    lens: np.ndarray, across: ArrayLike, along: ArrayLike, angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the CCD of light through points of the stop, by Snell's law at every surface.

    lens (N, 4): as `singlet` returns it.
    across, along: positions on the stop; the light arrives at ``angle`` (rad) in the plane of the
        first.

    Returns
    -------
    tuple of two arrays
        Positions on the CCD, in the lens's unit of length.
    """
    across, along = np.broadcast_arrays(np.asarray(across, float), np.asarray(along, float))
    place = np.stack([across.ravel(), along.ravel(), np.zeros(across.size)])
    direction = np.tile([[np.sin(angle)], [0], [np.cos(angle)]], across.size)
    before, distance = 1.0, lens[0, 2]
    for radius, conic, behind, index in lens[1:]:
        place[2] -= distance
        curvature = 1 / radius if radius else 0.0
        stretch = np.array([[1], [1], [1 + conic]])
        # the conic c (x^2 + y^2 + (1 + k) z^2) = 2 z on the line place + step direction
        square = curvature * (stretch * direction * direction).sum(0)
        slope = direction[2] - curvature * (stretch * place * direction).sum(0)
        gap = curvature * (stretch * place * place).sum(0) - 2 * place[2]
        place += gap / (slope + np.sqrt(slope**2 - square * gap)) * direction
        normal = np.array([[0], [0], [1]]) - curvature * stretch * place
        normal /= np.linalg.norm(normal, axis=0)
        ratio = before / index
        arriving = (direction * normal).sum(0)
        leaving = np.sqrt(1 - ratio**2 * (1 - arriving**2))
        direction = ratio * direction + (leaving - ratio * arriving) * normal
        before, distance = index, behind
    place += (distance - place[2]) / direction[2] * direction
    return place[0].reshape(across.shape), place[1].reshape(across.shape)
