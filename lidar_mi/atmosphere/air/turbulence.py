"""Homogeneous isotropic turbulence of a given energy spectrum, without divergence, anywhere.

A sum of Fourier modes (Kraichnan, Phys. Fluids 13, 22-31, 1970): it has no grid, no period and no
volume that a flight could leave.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.errors import InputError

Spectrum = Literal["von_karman", "kolmogorov"]
Evolution = Literal["frozen", "turnover", "sweeping"]

VON_KARMAN = 1.339
"""Constant a of von Karman's spectrum: Gamma(1/3) / (sqrt(pi) Gamma(5/6)), rounded."""

KOLMOGOROV_ONSET = (55 / (9 * math.pi) * VON_KARMAN ** (-5 / 3)) ** 1.5
"""First wavenumber of the Kolmogorov spectrum times L: its inertial range is von Karman's."""

UNSTEADINESS = 0.5
"""Rate of a mode over sqrt(k^3 E(k)) (Fung et al., J. Fluid Mech. 236, 281-318, 1992)."""

MODES = 600
"""Number of modes of a field."""

# Longest waves over the length scale, 2 pi / (k L): 5e-5 of von Karman's energy is in longer ones.
_LOWEST = 0.05
# Nodes of Gauss and Legendre's quadrature in a stratum, which is a fraction of an octave.
_NODES = 4
# Places of a chunk: its phases fill 10 MB.
_CHUNK = 2048


def energy_spectrum(k: ArrayLike, sigma: float, length: float, spectrum: Spectrum) -> np.ndarray:
    """E(k), m^3 s^-2: its integral over k is 3/2 sigma^2.

    von Karman: sigma^2 L 55/(9 pi) (a L k)^4 / (1 + (a L k)^2)^(17/6), a = 1.339 (von Karman, Proc.
    Natl. Acad. Sci. 34, 530-539, 1948; Etkin, Dynamics of Atmospheric Flight, 1972, chapter 13).
    Kolmogorov: sigma^2 k0^(2/3) k^(-5/3) from k0 on, nothing below. k0 = 1.306/L makes the inertial
    range, and with it the dissipation, that of von Karman's spectrum.

    k: wavenumber, rad/m.
    sigma: rms of one component, m/s.
    length: L, the integral scale along the wind of von Karman's spectrum, m.
    spectrum {"von_karman", "kolmogorov"}
    """
    k = np.asarray(k, float)
    if spectrum == "von_karman":
        q = (VON_KARMAN * length * k) ** 2
        return sigma**2 * length * 55 / (9 * np.pi) * q**2 / (1 + q) ** (17 / 6)
    onset = KOLMOGOROV_ONSET / length
    law = sigma**2 * onset ** (2 / 3) * np.maximum(k, onset) ** (-5 / 3)
    return np.where(k >= onset, law, 0.0)


@dataclass(frozen=True, eq=False)
class Turbulence:
    """One realisation of turbulence: a Gaussian field without divergence.

    u(x, t) = sum over modes of a cos(k x - w t) + b sin(k x - w t) with a and b normal to k. Every
    octave of wavenumbers has the same number of modes, with the energy of the spectrum.

    waves (4, modes): k (rad/m) and -w (rad/s) of every mode.
    amplitudes (2, modes, 3): a and b, m/s.
    """

    waves: np.ndarray
    amplitudes: np.ndarray

    def velocity(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m/s) at places (m) and times (s), which broadcast; to 1e-5 of the rms."""
        broadcast = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        shape, at = broadcast[0].shape, np.stack([a.ravel() for a in broadcast], axis=-1)
        wind = np.empty((len(at), 3))
        waves = self.waves.astype(np.float32)
        even, odd = self.amplitudes.astype(np.float32)
        for start in range(0, len(at), _CHUNK):
            part = at[start : start + _CHUNK]
            # phases from the chunk's middle are small: single precision, in which sines are fast
            middle = part.mean(axis=0)
            offset = np.mod(middle @ self.waves, 2 * np.pi).astype(np.float32)
            phase = (part - middle).astype(np.float32) @ waves + offset
            wind[start : start + _CHUNK] = np.cos(phase) @ even + np.sin(phase) @ odd
        u, v, w = np.moveaxis(wind.reshape(*shape, 3), -1, 0)
        return u, v, w


def turbulence(
    sigma: float,
    length: float,
    seed: int,
    *,
    spectrum: Spectrum = "von_karman",
    shortest: float = 2.0,
    evolution: Evolution = "frozen",
    modes: int = MODES,
) -> Turbulence:
    """A realisation of turbulence.

    sigma: rms of one component, m/s, >= 0, of the whole spectrum.
    length: length scale, m, of `energy_spectrum`.
    spectrum {"von_karman", "kolmogorov"}
    shortest: shortest wavelength, m, at most a tenth of the length. Finer turbulence is missing.
    evolution {"frozen", "turnover", "sweeping"}: in the frame of the mean wind. Frozen (Taylor): at
        rest. Turnover: the rates of the modes are normal with a standard deviation of
        `UNSTEADINESS` sqrt(k^3 E(k)). Sweeping: of sigma k, as large eddies carry small ones past a
        place (Tennekes, J. Fluid Mech. 67, 561-567, 1975); waves lose their correlation as
        exp(-(sigma k t)^2/2).
    modes: 60 or more.
    """
    for name, value, allowed, words in (
        ("sigma", sigma, sigma >= 0, "0 m/s or more"),
        ("length", length, length > 0, "above 0 m"),
        ("shortest", shortest, 0 < shortest <= length / 10, f"above 0, at most {length / 10:g} m"),
        ("modes", modes, modes >= 60, "60 or more"),
        ("spectrum", spectrum, spectrum in get_args(Spectrum), " or ".join(get_args(Spectrum))),
        ("evolution", evolution, evolution in get_args(Evolution), ", ".join(get_args(Evolution))),
    ):
        if not allowed:
            raise InputError(f"turbulence.{name}: {value} is not allowed; expected {words}")
    # the generator by its name: numpy may change the one of default_rng
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0x7B])))
    lowest = (_LOWEST if spectrum == "von_karman" else KOLMOGOROV_ONSET) / length
    edges = np.linspace(math.log(lowest), math.log(2 * np.pi / shortest), modes + 1)
    width = edges[1] - edges[0]
    # energy of the strata of ln k
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    within = np.exp(edges[:-1, None] + width * (1 + nodes) / 2)
    energy = (within * energy_spectrum(within, sigma, length, spectrum)) @ weights * width / 2
    k = np.exp(edges[:-1] + width * random.random(modes))
    direction = random.standard_normal((modes, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # of three components with the variance s^2, two remain after projection: the energy is s^2
    amplitudes = random.standard_normal((2, modes, 3)) * np.sqrt(energy)[:, None]
    amplitudes -= (amplitudes * direction).sum(-1, keepdims=True) * direction
    rate = {
        "frozen": np.zeros(modes),
        "turnover": UNSTEADINESS * np.sqrt(k**3 * energy_spectrum(k, sigma, length, spectrum)),
        "sweeping": sigma * k,
    }[evolution]
    rate = rate * random.standard_normal(modes)
    return Turbulence(np.vstack([(k[:, None] * direction).T, -rate]), amplitudes)
