"""Molecular scattering against published numbers: detects 0.05 % in the cross-section, 1e-5 in the
King factor, 1 % in depolarisation, and any mix-up of Cabannes line and whole Rayleigh band."""

import math

import pytest

from lidar_mi.atmosphere.scattering import molecules
from lidar_mi.errors import InputError


@pytest.mark.parametrize(
    "wavelength, square_centimetres, king",
    [(355e-9, 2.759e-26, 1.05289), (532e-9, 5.167e-27, 1.04899), (1064e-9, 3.127e-28, 1.04721)],
)
def test_laser_wavelengths(wavelength, square_centimetres, king):
    """By the equations of Bodhaine et al. (1999, J. Atmos. Ocean. Technol. 16, 1854), which
    `test_bucholtz` confirms to 0.2 %; 5.167e-27 cm^2 is also what analyses of CALIPSO use."""
    assert molecules.cross_section(wavelength) * 1e4 == pytest.approx(square_centimetres, rel=2e-4)
    assert molecules.king_factor(wavelength) == pytest.approx(king, abs=0.6e-5)


@pytest.mark.parametrize("micrometres", [0.25, 0.30, 0.40, 0.55, 0.70, 0.85])
def test_published_fit_of_the_cross_section(micrometres):
    """Bodhaine et al., eq. 29: within 0.01 % of their own numbers from 0.25 to 0.85 um."""
    square = micrometres**2
    fit = 1.0455996 - 341.29061 / square - 0.90230850 * square
    fit /= 1 + 0.0027059889 / square - 85.968563 * square
    assert molecules.cross_section(micrometres * 1e-6) == pytest.approx(fit * 1e-32, rel=2e-4)


@pytest.mark.parametrize("micrometres", [0.25, 0.355, 0.48, 0.532, 0.7, 1.064, 1.55])
def test_bucholtz(micrometres):
    """His fit of 1995 (Appl. Opt. 34, 2765, table 3), with other King factors: 0.35 %."""
    a, b, c, d = (
        (3.01577e-28, 3.55212, 1.35579, 0.11563)
        if micrometres < 0.5
        else (4.01061e-28, 3.99668, 1.10298e-3, 2.71393e-2)
    )
    fit = a * micrometres ** -(b + c * micrometres + d / micrometres)
    assert molecules.cross_section(micrometres * 1e-6) * 1e4 == pytest.approx(fit, rel=3.5e-3)


@pytest.mark.parametrize("micrometres", [0.355, 0.532, 0.6328, 1.064])
def test_refractive_index_of_standard_air(micrometres):
    """Edlen's formula of 1966 (15 degrees C, 300 ppm CO2), an independent fit: 0.02 %."""
    square = micrometres**-2
    edlen = 1e-8 * (8342.13 + 2406030 / (130 - square) + 15997 / (38.9 - square))
    index = molecules.refractive_index(micrometres * 1e-6, 300e-6)
    assert index - 1 == pytest.approx(edlen, rel=2e-4)


def test_refractive_index_rises_with_carbon_dioxide():
    # CO2 raises the refractivity by 54 % of its share
    ratio = (molecules.refractive_index(532e-9, 0.01) - 1) / (
        molecules.refractive_index(532e-9, 0.0) - 1
    )
    assert ratio == pytest.approx((1 + 0.54 * 0.0097) / (1 - 0.54 * 0.0003), rel=1e-12)


def test_king_factor_is_that_of_the_depolarisation_factor():
    """(6 + 3 d)/(6 - 7 d), the definition, for the whole band."""
    king = molecules.king_factor(532e-9)
    d = molecules.depolarization_factor(king, "rayleigh")
    assert (6 + 3 * d) / (6 - 7 * d) == pytest.approx(king, rel=1e-12)
    # air in the visible: 0.0279 (Young 1980) to 0.031 (Hansen & Travis 1974)
    assert 0.0275 < d < 0.0310


def test_depolarisation_of_the_cabannes_line_and_of_the_whole_band():
    """532 nm: 0.0036 and 0.0143 (Behrendt & Nakamura 2002, Opt. Express 10, 805), to 2 %, for
    their King factor is not quite this one."""
    narrow = molecules.molecular_scattering(532e-9, band="cabannes")
    wide = molecules.molecular_scattering(532e-9, band="rayleigh")
    assert narrow.depolarization_ratio == pytest.approx(0.0036, rel=0.02)
    assert wide.depolarization_ratio == pytest.approx(0.0143, rel=0.02)
    for air in (narrow, wide):
        d = air.depolarization
        assert air.depolarization_ratio == pytest.approx(d / (2 - d), rel=1e-12)


def test_lidar_ratio():
    """Isotropic molecules: 8 pi/3; air a little more, most of it in the Cabannes line."""
    narrow = molecules.molecular_scattering(532e-9, band="cabannes")
    wide = molecules.molecular_scattering(532e-9, band="rayleigh")
    for air in (narrow, wide):
        assert air.lidar_ratio == pytest.approx(air.extinction / air.backscatter, rel=1e-12)
    # Chandrasekhar's phase function with gamma = d/(2 - d)
    gamma = wide.depolarization / (2 - wide.depolarization)
    assert wide.lidar_ratio == pytest.approx(
        8 * math.pi / 3 * (1 + 2 * gamma) / (1 + gamma), rel=1e-12
    )
    # She 2001: the Cabannes line holds about 97.5 % of the backscatter of the whole band
    assert narrow.backscatter / wide.backscatter == pytest.approx(0.975, abs=0.002)


def test_sum_over_lines_is_the_whole_band():
    """Cabannes + Raman = whole: the Raman part is pure anisotropic scattering, three quarters."""
    king = molecules.king_factor(532e-9)
    whole = molecules.anisotropy(king, "rayleigh")
    narrow = molecules.molecular_scattering(532e-9, band="cabannes")
    raman = 7.5 * whole / (45 + 10 * whole)
    assert narrow.albedo + raman == pytest.approx(1, rel=1e-12)


def test_table_agrees_with_the_coefficients():
    for band in molecules.BANDS:
        air = molecules.molecular_scattering(355e-9, 26500.0, 223.25, band)
        table = molecules.molecular_table(355e-9, 26500.0, 223.25, band)
        assert table.extinction == pytest.approx(air.extinction, rel=1e-12)
        assert table.backscatter == pytest.approx(air.backscatter, rel=1e-12)
        assert table.lidar_ratio == pytest.approx(air.lidar_ratio, rel=1e-12)
        assert table.depolarization_ratio == pytest.approx(air.depolarization_ratio, rel=1e-12)
        assert table.albedo == air.albedo


def test_number_density_and_extinction_at_sea_level():
    """Loschmidt's constant, and Bodhaine's standard air, to their rounding."""
    assert molecules.number_density(101325.0, 273.15) == pytest.approx(2.686780e25, rel=1e-6)
    air = molecules.molecular_scattering(532e-9)
    assert air.number_density == pytest.approx(2.546899e25, rel=2e-5)
    assert air.extinction == pytest.approx(air.number_density * air.cross_section, rel=1e-12)
    # 1.32e-2 / km, the sea-level textbook value at 532 nm
    assert air.extinction == pytest.approx(1.316e-5, rel=1e-3)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: molecules.cross_section(532.0), "wavelength: 532.0 m"),
        (lambda: molecules.cross_section(532e-9, co2=360), "co2: 360"),
        (lambda: molecules.number_density(-1.0, 300.0), "pressure: -1.0"),
        (lambda: molecules.number_density(1e5, float("nan")), "temperature: nan"),
        (lambda: molecules.molecular_scattering(532e-9, band="raman"), "band: 'raman'.*cabannes"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(InputError, match=words):
        call()
