"""Speckle of the received light: independent patterns in time and over the telescope."""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar


def footprint_radius(lidar: BackscatterLidar, distance: ArrayLike) -> np.ndarray:
    """1/e^2 radius of the beam at a distance (m), limited by the field of view, m.

    A Gaussian with the variance of the truncated aperture plus the divergence. Area pi w^2 is
    (integral of I)^2 / integral of I^2; it is exact for an uncut beam and for one cut far inside
    its 1/e^2 radius, 10 % too small for a collimated one cut there (divergence hides that: the
    paper's is 2 % too small at 100 m, 0.01 % at 500 m). The field of view is a disc with a sharp
    edge: there the area is pi w^2 tanh(R^2 / w^2) for radius R, exact for a Gaussian.
    """
    distance = np.asarray(distance, float)
    squared = lidar.radius_at(distance) ** 2
    return np.sqrt(squared * np.tanh((distance * lidar.fov_half) ** 2 / squared))


def temporal_modes(line_width: float, duration: ArrayLike) -> np.ndarray:
    """Independent speckle patterns in the recording time of a gate.

    M = [2/T int_0^T (1 - t/T) |g(t)|^2 dt]^-1 for a Gaussian line (Goodman, Statistical Optics,
    1985, section 6.1), whose coherence time int |g|^2 dt is sqrt(2 ln 2 / pi) / line_width =
    0.66 / line_width. ``line_width`` (Hz) is full width at half maximum, ``duration`` is T (s).
    """
    # the duration in coherence times
    x = np.asarray(duration, float) * line_width / np.sqrt(2 * np.log(2) / np.pi)
    return 1 / (
        scipy.special.erf(np.sqrt(np.pi) * x) / x + np.expm1(-np.pi * x**2) / (np.pi * x**2)
    )


def spatial_modes(
    aperture_radius: float, wavelength: float, footprint: ArrayLike, distance: ArrayLike
) -> np.ndarray:
    """Speckle grains in the telescope: A Omega / lambda^2, and 1 when a grain is larger than it.

    M = [1/A^2 int int |mu(p - q)|^2 dp dq]^-1 over the aperture, where mu is the coherence that a
    Gaussian footprint of incoherent scatterers makes (van Cittert-Zernike; Goodman, Speckle
    Phenomena in Optics, 2007, section 4.7). For a circular aperture that is
    a / 2 / (1 - e^-a (I_0(a) + I_1(a))) with a = 2 (pi w R / (lambda r))^2; for large a it is the
    etendue in units of lambda^2, with A = pi R^2 and Omega = pi w^2 / r^2. All are in m; the
    footprint is the 1/e^2 radius w of the beam at the distance r.
    """
    footprint, distance = np.asarray(footprint, float), np.asarray(distance, float)
    a = 2 * (np.pi * footprint * aperture_radius / (wavelength * distance)) ** 2
    # 1 + a / 2 is the series; for small a the closed form loses digits
    small = a < 1e-6
    safe = np.where(small, 1.0, a)
    # ive is scaled by exp(-a): the functions themselves overflow
    closed = safe / 2 / (1 - scipy.special.ive(0, safe) - scipy.special.ive(1, safe))
    return np.where(small, 1 + a / 2, closed)


def speckle_modes(
    detector: Detector,
    lidar: BackscatterLidar,
    duration: ArrayLike,
    distance: ArrayLike,
    polarization: ArrayLike = 1.0,
) -> float | np.ndarray:
    """Degrees of freedom M of the received light: its relative variance is 1 / M.

    Temporal times spatial modes, times 2 / (1 + P^2) for light of degree of polarisation P, as both
    polarisations are counted (Goodman, Statistical Optics, section 6.1). Light scattered several
    times comes from a wider spot, so M is a lower bound there. ``detector.speckle_modes`` replaces
    all of it; without ``detector.speckle`` M is infinite.

    duration: time in which the gate is recorded, s.
    distance: range of the gate, m.
    polarization: degree of polarisation of the received light, 0 to 1.

    Raises InputError: the line is narrower than a pulse of ``lidar.pulse_duration`` can have.
    """
    if not detector.speckle:
        return np.inf
    if detector.speckle_modes is not None:
        return detector.speckle_modes
    if detector.line_width * lidar.pulse_duration < 0.44 and lidar.pulse_duration > 0:
        raise InputError(
            f"detector.line_width: {detector.line_width:g} Hz is not allowed with pulses of "
            f"{lidar.pulse_duration:g} s; expected at least {0.44 / lidar.pulse_duration:g} Hz"
        )
    spatial = spatial_modes(
        lidar.aperture_radius, lidar.wavelength, footprint_radius(lidar, distance), distance
    )
    states = 2 / (1 + np.asarray(polarization, float) ** 2)
    return temporal_modes(detector.line_width, duration) * spatial * states
