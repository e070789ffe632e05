"""Rayleigh scattering by dry air (Bodhaine et al. 1999, J. Atmos. Oceanic Technol. 16, 1854).

Two bands must be distinguished. The *Rayleigh* band is everything that molecules scatter: the
central Cabannes line and the rotational Raman lines around it (within about +-10 nm at 532 nm),
which contain three quarters of the anisotropic part. The *Cabannes* line alone is what a
narrow-band receiver (filter below about 0.3 nm) detects. Extinction always takes the whole band, as
Raman-shifted light has left the laser's wavelength too. Vibrational Raman scattering (0.1 %) is
neglected. Water vapour is neglected: below 1 % in the cross-section.
"""

import math
from dataclasses import dataclass

import scipy

from lidar_mi.atmosphere.scattering.tables import ScatteringTable, rayleigh_table
from lidar_mi.errors import InputError

BANDS = ("cabannes", "rayleigh")

# Standard air of the refractive-index formula: 288.15 K, 1013.25 hPa (Bodhaine et al., sec. 3).
_STANDARD_NUMBER_DENSITY = 2.546899e25


@dataclass(frozen=True)
class MolecularScattering:
    """Air at one wavelength, pressure and temperature; from `molecular_scattering`.

    ``backscatter``, ``lidar_ratio``, ``depolarization``, ``depolarization_ratio`` and
    ``albedo`` are those of ``band``; ``cross_section`` and ``extinction`` are always those of the
    whole Rayleigh band.
    """

    band: str
    wavelength: float
    """m, in vacuum."""
    pressure: float
    """Pa."""
    temperature: float
    """K."""
    number_density: float
    """Molecules per m^3."""
    king_factor: float
    """King factor of the whole band."""
    cross_section: float
    """m^2 per molecule."""
    extinction: float
    """m^-1."""
    albedo: float
    """Part of the extinction that is scattered into the band."""
    backscatter: float
    """m^-1 sr^-1."""
    lidar_ratio: float
    """Extinction over backscatter, sr."""
    depolarization: float
    """Depolarisation factor of natural light at 90 degrees."""
    depolarization_ratio: float
    """Linear depolarisation ratio of backscatter."""


def refractive_index(wavelength: float, co2: float = 360e-6) -> float:
    """Refractive index of standard dry air, 288.15 K and 1013.25 hPa.

    Peck & Reeder (1972) for 300 ppm CO2 (Bodhaine et al., eq. 18), other CO2 by their eq. 19.
    Wavelengths (m) are those in vacuum, 200 nm to 2 um; ``co2`` is a volume fraction.
    """
    _check(wavelength, co2)
    # in um^-2, as the formula of Peck and Reeder
    wavenumber2 = (1e-6 / wavelength) ** 2
    refractivity = 1e-8 * (
        8060.51 + 2480990 / (132.274 - wavenumber2) + 17455.7 / (39.32957 - wavenumber2)
    )
    return 1 + refractivity * (1 + 0.54 * (co2 - 300e-6))


def king_factor(wavelength: float, co2: float = 360e-6) -> float:
    """King factor of dry air, (6 + 3 d)/(6 - 7 d) with d the depolarisation factor of the band.

    Bates (1984) for N2 and O2, 1.00 for Ar, 1.15 for CO2, weighted by volume (Bodhaine et al.,
    eqs. 5, 6 and 23).
    """
    _check(wavelength, co2)
    wavenumber2 = (1e-6 / wavelength) ** 2
    nitrogen = 1.034 + 3.17e-4 * wavenumber2
    oxygen = 1.096 + 1.385e-3 * wavenumber2 + 1.448e-4 * wavenumber2**2
    # the weights are per cent by volume
    percent = 100 * co2
    total = 78.084 * nitrogen + 20.946 * oxygen + 0.934 * 1.00 + percent * 1.15
    return total / (78.084 + 20.946 + 0.934 + percent)


def cross_section(wavelength: float, co2: float = 360e-6) -> float:
    """Rayleigh scattering cross-section of air, m^2 per molecule (Bodhaine et al., eq. 2).

    It does not depend on pressure or temperature, for (n^2 - 1)/(n^2 + 2) is proportional to
    the number density.
    """
    n2 = refractive_index(wavelength, co2) ** 2
    ratio = (n2 - 1) / (n2 + 2)
    density = _STANDARD_NUMBER_DENSITY
    scale = 24 * math.pi**3 * ratio**2 / (wavelength**4 * density**2)
    return scale * king_factor(wavelength, co2)


def anisotropy(king: float, band: str) -> float:
    """Squared anisotropy over squared mean of the polarisability that acts in a band.

    With e of the whole band, king = 1 + 2 e/9; a quarter of it stays in the Cabannes line
    (She 2001, Appl. Opt. 40, 4875), exact at room temperature to 1e-3 of the quarter.
    """
    if band not in BANDS:
        raise InputError(f"band: {band!r} is not allowed; expected one of {', '.join(BANDS)}")
    whole = 4.5 * (king - 1)
    return whole / 4 if band == "cabannes" else whole


def depolarization_factor(king: float, band: str = "cabannes") -> float:
    """Depolarisation factor of natural light at 90 degrees, 6 e/(45 + 7 e).

    It is the parameter of the ``rayleigh_polarized`` phase function.
    """
    e = anisotropy(king, band)
    return 6 * e / (45 + 7 * e)


def number_density(pressure: float, temperature: float) -> float:
    """Molecules per m^3 of an ideal gas, from Pa and K."""
    for name, value in (("pressure", pressure), ("temperature", temperature)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: {value!r} is not allowed; it must be > 0")
    return pressure / (scipy.constants.Boltzmann * temperature)


def molecular_scattering(
    wavelength: float,
    pressure: float = 101325.0,
    temperature: float = 288.15,
    band: str = "cabannes",
    co2: float = 360e-6,
) -> MolecularScattering:
    """Optical properties of molecular air that a lidar measurement depends on.

    wavelength: m, in vacuum.
    pressure, temperature: Pa, K; see `lidar_mi.atmosphere.air.standard_atmosphere`.
    band {"cabannes", "rayleigh"}: what the receiver lets through: the Cabannes line (narrow filter)
        or all of it.
    co2: volume fraction.
    """
    king = king_factor(wavelength, co2)
    # extinction is by the whole band, the received light that of one
    whole, in_band = anisotropy(king, "rayleigh"), anisotropy(king, band)
    density = number_density(pressure, temperature)
    sigma = cross_section(wavelength, co2)
    extinction = density * sigma
    # Intensity ratios of a freely turning linear molecule (Placzek): total 45 + 10 e,
    # backward 45 + 7 e with 3/(8 pi) of the isotropic part.
    per_extinction = 3 / (8 * math.pi) * (45 + 7 * in_band) / (45 + 10 * whole)
    return MolecularScattering(
        band=band,
        wavelength=wavelength,
        pressure=pressure,
        temperature=temperature,
        number_density=density,
        king_factor=king,
        cross_section=sigma,
        extinction=extinction,
        albedo=(45 + 10 * in_band) / (45 + 10 * whole),
        backscatter=extinction * per_extinction,
        lidar_ratio=1 / per_extinction,
        depolarization=depolarization_factor(king, band),
        depolarization_ratio=3 * in_band / (45 + 4 * in_band),
    )


def molecular_table(
    wavelength: float,
    pressure: float = 101325.0,
    temperature: float = 288.15,
    band: str = "cabannes",
    co2: float = 360e-6,
) -> ScatteringTable:
    """Air as a scattering table, to mix with aerosol; parameters as `molecular_scattering`.

    In the Cabannes band the albedo is 0.965, not 1: Raman-shifted light is lost to a narrow
    receiver.
    """
    air = molecular_scattering(wavelength, pressure, temperature, band, co2)
    return rayleigh_table(
        air.depolarization,
        wavelength,
        air.cross_section,
        air.albedo,
        name=f"air_{band}",
        number_density=air.number_density,
        provenance=f"Bodhaine et al. 1999, {band} band, {pressure:g} Pa, {temperature:g} K, "
        f"{co2 * 1e6:g} ppm CO2",
    )


def _check(wavelength: float, co2: float) -> None:
    if not 0.2e-6 <= wavelength <= 2e-6:
        raise InputError(f"wavelength: {wavelength!r} m is not allowed; expected 2e-7 to 2e-6 m")
    if not 0 <= co2 <= 0.01:
        raise InputError(f"co2: {co2!r} is not allowed; expected a volume fraction, 0 to 0.01")
