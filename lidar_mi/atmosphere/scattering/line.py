"""The backscattered line: broadening and shift by the motion, temperature and pressure of the air.

Every line here is a sum of Gaussians, so that its Fourier transform, which an etalon's series
needs, is a closed form. Widths are full widths at half maximum, sigmas are standard deviations;
frequencies are offsets from the laser's, in Hz.

Signs: an approaching scatterer (v_LOS > 0) raises the frequency, by 2 v_LOS / wavelength.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

SHAPES = ("rayleigh", "rayleigh_brillouin")

# Mean molar mass of dry air, kg / mol (ICAO standard atmosphere).
_MOLAR_MASS = 28.9644e-3
_FWHM = 2 * math.sqrt(2 * math.log(2))


@dataclass(frozen=True, eq=False)
class Line:
    """A spectral line as a sum of Gaussians about the laser's frequency.

    wavelength: m, in vacuum, of the laser; the zero of the offsets.
    weights (K,): fraction of the photons in each Gaussian, 0 or more, with a sum of one.
    offsets, sigmas (K,): centres and standard deviations, Hz; sigma 0 is a monochromatic line.
    """

    wavelength: float
    weights: np.ndarray
    offsets: np.ndarray
    sigmas: np.ndarray

    def __post_init__(self) -> None:
        _check("line.wavelength", self.wavelength, self.wavelength > 0, "m above 0")
        for name in ("weights", "offsets", "sigmas"):
            values = np.array(getattr(self, name), float, ndmin=1)
            # frozen as the class is, which does not reach into arrays
            values.flags.writeable = False
            object.__setattr__(self, name, values)
            allowed = "finite Hz" if name == "offsets" else "0 or more"
            _check(f"line.{name}", values, (values >= 0) | (name == "offsets"), allowed)
        if not self.weights.shape == self.offsets.shape == self.sigmas.shape:
            raise InputError("line: expected as many weights as offsets and sigmas")
        total = self.weights.sum()
        _check("line.weights", total, abs(total - 1) < 1e-9, "a sum of 1")

    @property
    def mean(self) -> float:
        """Mean offset, Hz."""
        return float(self.weights @ self.offsets)

    @property
    def width(self) -> float:
        """Full width at half maximum about the highest point, Hz; 0 of a monochromatic line.

        For lines that fall on both sides of one maximum, as all lines made here do.
        """
        if not self.sigmas.all():
            return 0.0
        extent = 10 * self.sigmas.max() + np.ptp(self.offsets)
        nu = self.mean + np.linspace(-extent, extent, 20_001)
        peak = nu[np.argmax(self.pdf(nu))]
        half = self.pdf(peak) / 2
        # to 1 Hz, of widths of MHz and more
        left, right = (
            scipy.optimize.brentq(
                lambda x: float(self.pdf(x) - half), peak, peak + side * extent, xtol=1.0
            )
            for side in (-1, 1)
        )
        return right - left

    @property
    def information(self) -> float:
        """Fisher information of a photon's frequency on the place of the line, 1 / Hz^2.

        int (dS / dnu)^2 / S dnu, 1 / sigma^2 of one Gaussian. Of N photons no receiver knows the
        place better than to 1 / (N information)^(1/2) (Cramer-Rao), which an ideal spectral
        analyser does.

        Raises InputError: a line with a monochromatic part, whose place has no error.
        """
        if not self.sigmas.all():
            raise InputError("line.sigmas: 0 Hz is not allowed; expected a line with a width")
        # by Gauss-Legendre quadrature, on pieces of one sigma of every Gaussian
        edges = np.unique(self.offsets[:, None] + self.sigmas[:, None] * np.arange(-12, 13))
        node, weight = np.polynomial.legendre.leggauss(16)
        half = np.diff(edges)[:, None] / 2
        nu = edges[:-1, None] + half * (1 + node)
        z = (nu[..., None] - self.offsets) / self.sigmas
        densities = self.weights / self.sigmas * np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
        slope, density = (z / self.sigmas * densities).sum(-1), densities.sum(-1)
        return float((half * weight * slope**2 / density).sum())

    def characteristic(self, t: ArrayLike) -> np.ndarray:
        """Fourier transform <exp(2 pi i nu t)> over the line, complex, at the times ``t`` (s)."""
        t = np.asarray(t, float)[..., None]
        phase = 2j * np.pi * t * self.offsets
        return np.exp(phase - 2 * (np.pi * t * self.sigmas) ** 2) @ self.weights

    def pdf(self, nu: ArrayLike) -> np.ndarray:
        """Fraction of the photons per Hz at the offsets ``nu`` (Hz); no sigma may be 0."""
        z = (np.asarray(nu, float)[..., None] - self.offsets) / self.sigmas
        return np.exp(-(z**2) / 2) @ (self.weights / (math.sqrt(2 * math.pi) * self.sigmas))

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Frequency offsets of ``n`` photons, Hz."""
        component = rng.choice(len(self.weights), n, p=self.weights)
        return self.offsets[component] + self.sigmas[component] * rng.standard_normal(n)

    def shifted(self, offset: float) -> "Line":
        """The line shifted by ``offset`` Hz."""
        return replace(self, offsets=self.offsets + offset)

    def broadened(self, sigma: float) -> "Line":
        """The line convolved with a Gaussian of standard deviation ``sigma`` (Hz)."""
        return replace(self, sigmas=np.hypot(self.sigmas, sigma))


def laser_line(wavelength: float, laser_width: float) -> Line:
    """The emitted line: one Gaussian of full width ``laser_width`` (Hz) at half maximum."""
    _check("laser_width", laser_width, laser_width >= 0, "0 Hz or more")
    return Line(wavelength, np.ones(1), np.zeros(1), np.array([laser_width / _FWHM]))


def rayleigh_width(wavelength: float, temperature: float) -> float:
    """Full width at half maximum of backscatter by molecules that never collide, Hz.

    sigma = 2 v0 / wavelength with v0 = (k T / m)^(1/2), the thermal speed along one axis.
    """
    _check("wavelength", wavelength, wavelength > 0, "m above 0")
    _check("temperature", temperature, temperature > 0, "K above 0")
    # the Doppler shift of backscatter is 2 v / wavelength
    molecule = _MOLAR_MASS / scipy.constants.Avogadro
    return _FWHM * 2 / wavelength * math.sqrt(scipy.constants.Boltzmann * temperature / molecule)


def rayleigh(wavelength: float, temperature: float) -> Line:
    """Line of molecules that never collide: one Gaussian (m, K)."""
    sigma = rayleigh_width(wavelength, temperature) / _FWHM
    return Line(wavelength, np.ones(1), np.zeros(1), np.array([sigma]))


def viscosity(temperature: float) -> float:
    """Shear viscosity of air, Pa s, by Sutherland's formula (ICAO standard atmosphere)."""
    return 1.458e-6 * temperature**1.5 / (temperature + 110.4)


def rayleigh_brillouin(wavelength: float, temperature: float, pressure: float) -> Line:
    """Backscattered line of air (m, K, Pa), with Brillouin scattering by thermal sound waves.

    Three Gaussians fitted to the Tenti S6 model (Witschas 2011, Appl. Opt. 50, 267, with the
    coefficients of the erratum, Appl. Opt. 50, 5758): in the units x of 2^(1/2) 2 v0 / wavelength
    their widths and places depend on y = p / (2^(1/2) k v0 eta) alone, k = 4 pi / wavelength. Good
    to 0.85 % of the peak; the missing wings leave an rms 0.4 % (y = 0.17) to 1.5 % (y = 1) below
    that of molecules without collisions, which it should equal.

    Raises InputError: y beyond 1.027, where the fit ends.
    """
    _check("pressure", pressure, pressure >= 0, "0 Pa or more")
    unit = math.sqrt(2) * rayleigh_width(wavelength, temperature) / _FWHM
    y = pressure / (2 * math.pi * unit * viscosity(temperature))
    _check("y = pressure / (2^(1/2) k v0 viscosity)", y, y <= 1.027, "0 to 1.027")
    # the fit's sum at y = 0 is 1.0005: the outer Gaussians keep weights of 0 or more there
    centre = min(1, 0.18526 * math.exp(-1.31255 * y) + 0.07103 * math.exp(-18.26117 * y) + 0.74421)
    sigma_r = 0.70813 - 0.16366 * y**2 + 0.19132 * y**3 - 0.07217 * y**4
    sigma_b = 0.07845 * math.exp(-4.88663 * y) + 0.804 * math.exp(-0.15003 * y) - 0.45142
    place = 0.80893 - 0.30208 * 0.10898**y
    # both Brillouin lines are equally strong: the air is in equilibrium
    side = (1 - centre) / 2
    return Line(
        wavelength,
        np.array([side, centre, side]),
        unit * np.array([-place, 0, place]),
        unit * np.array([sigma_b, sigma_r, sigma_b]),
    )


def backscatter_line(
    wavelength: float,
    temperature: float,
    pressure: float,
    laser_width: float = 100e6,
    aerosol_fraction: float = 0.0,
    shape: str = "rayleigh_brillouin",
) -> Line:
    """Line of the backscatter of air at rest, molecules and aerosol, with the laser's own width.

    wavelength, temperature, pressure: m, K, Pa; see `lidar_mi.atmosphere.air.standard_atmosphere`.
    laser_width: full width at half maximum of the emitted line, Hz.
    aerosol_fraction: fraction of the backscattered photons from aerosol, 0 to 1; aerosol is too
        heavy to broaden the line.
    shape {"rayleigh", "rayleigh_brillouin"}: of the molecular line.
    """
    if shape not in SHAPES:
        raise InputError(f"shape: {shape!r} is not allowed; expected one of {', '.join(SHAPES)}")
    _check("aerosol_fraction", aerosol_fraction, 0 <= aerosol_fraction <= 1, "0 to 1")
    laser = laser_line(wavelength, laser_width)
    if shape == "rayleigh":
        air = rayleigh(wavelength, temperature)
    else:
        air = rayleigh_brillouin(wavelength, temperature, pressure)
    # convolved with the laser's line; of Gaussians the variances add
    air = air.broadened(laser.sigmas[0])
    weights = np.concatenate([[aerosol_fraction], (1 - aerosol_fraction) * air.weights])
    offsets, sigmas = np.append(laser.offsets, air.offsets), np.append(laser.sigmas, air.sigmas)
    # a monochromatic Gaussian of weight 0 would still have no density
    present = weights > 0
    return Line(wavelength, weights[present], offsets[present], sigmas[present])


def _check(name: str, value: np.ndarray | float, good: np.ndarray | bool, allowed: str) -> None:
    values = np.atleast_1d(value)
    fine = np.atleast_1d(good) & np.isfinite(values)
    if not fine.all():
        raise InputError(f"{name}: {values[~fine][0]:g} is not allowed; expected {allowed}")
