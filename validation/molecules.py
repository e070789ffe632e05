"""Molecular scattering against published numbers."""

import math

from lidar_mi.atmosphere.scattering import molecules

from .report import Check, Row

TITLE = "Molecules"
INTRODUCTION = "Dry air of `lidar_mi.atmosphere.scattering.molecules`."


def cross_sections(effort):
    """Cross-sections and King factors at the wavelengths of lidars."""
    paper = "Bodhaine et al. 1999"
    rows = []
    for nanometres, square_centimetres, king in (
        (355, 2.759e-26, 1.05289),
        (532, 5.167e-27, 1.04899),
        (1064, 3.127e-28, 1.04721),
    ):
        wavelength = nanometres * 1e-9
        rows += [
            Row(
                f"cross-section at {nanometres} nm",
                paper,
                square_centimetres,
                molecules.cross_section(wavelength) * 1e4,
                tolerance=2e-4 * square_centimetres,
                unit="cm2",
            ),
            Row(
                f"King factor at {nanometres} nm",
                paper,
                king,
                molecules.king_factor(wavelength),
                tolerance=0.6e-5,
            ),
        ]
    for micrometres in (0.25, 0.30, 0.40, 0.55, 0.70, 0.85):
        square = micrometres**2
        fit = 1.0455996 - 341.29061 / square - 0.90230850 * square
        fit /= 1 + 0.0027059889 / square - 85.968563 * square
        rows.append(
            Row(
                f"cross-section at {micrometres:g} um",
                "fit of Bodhaine et al. 1999, eq. 29",
                fit * 1e-28,
                molecules.cross_section(micrometres * 1e-6) * 1e4,
                tolerance=2e-4 * fit * 1e-28,
                unit="cm2",
            )
        )
    return Check(
        "Cross-sections and King factors",
        "Published numbers have four digits and the fit has an accuracy of 0.01 %; revisions of "
        "the physical constants are smaller.",
        tuple(rows),
    )


def refraction(effort):
    """The refractive index by an older, independent fit."""
    rows = []
    for micrometres in (0.355, 0.532, 1.064):
        square = micrometres**-2
        edlen = 1e-8 * (8342.13 + 2406030 / (130 - square) + 15997 / (38.9 - square))
        rows.append(
            Row(
                f"refractivity at {1e3 * micrometres:g} nm, 300 ppm CO2",
                "Edlen 1966",
                edlen,
                molecules.refractive_index(micrometres * 1e-6, 300e-6) - 1,
                tolerance=2e-4 * edlen,
            )
        )
    return Check(
        "Refractive index", "Two fits to different measurements agree to 2e-4.", tuple(rows)
    )


def depolarisation(effort):
    """Depolarisation and lidar ratios of the Cabannes line and of the whole band."""
    rows = []
    for band, published in (("cabannes", 0.0036), ("rayleigh", 0.0143)):
        air = molecules.molecular_scattering(532e-9, band=band)
        delta, ratio = air.depolarization, air.depolarization_ratio
        rows += [
            Row(
                f"{band}: depolarisation ratio at 532 nm",
                "Behrendt & Nakamura 2002",
                published,
                ratio,
                tolerance=0.02 * published,
            ),
            Row(
                f"{band}: depolarisation ratio",
                "D / (2 - D)",
                delta / (2 - delta),
                ratio,
                tolerance=1e-9,
            ),
        ]
    gamma = delta / (2 - delta)
    rows += [
        Row(
            "rayleigh: lidar ratio",
            "Chandrasekhar 1950: 8 pi / 3 (1 + 2 g) / (1 + g)",
            8 * math.pi / 3 * (1 + 2 * gamma) / (1 + gamma),
            air.lidar_ratio,
            tolerance=1e-9,
            unit="sr",
        ),
        Row(
            "backscatter of the Cabannes line over the band",
            "She 2001",
            0.975,
            molecules.molecular_scattering(532e-9, band="cabannes").backscatter / air.backscatter,
            tolerance=0.002,
        ),
        Row(
            "King factor of the band's depolarisation factor",
            "(6 + 3 D) / (6 - 7 D)",
            (6 + 3 * delta) / (6 - 7 * delta),
            air.king_factor,
            tolerance=1e-9,
        ),
    ]
    return Check(
        "Depolarisation of backscatter",
        "Behrendt & Nakamura used slightly different King factors (2 %).",
        tuple(rows),
    )


def density(effort):
    """Number density and extinction at sea level."""
    air = molecules.molecular_scattering(532e-9)
    return Check(
        "Air at sea level",
        "Standard atmosphere, 288.15 K and 1013.25 hPa.",
        (
            Row(
                "Loschmidt's constant",
                "CODATA 2018",
                2.686780111e25,
                molecules.number_density(101325.0, 273.15),
                tolerance=1e18,
                unit="1/m3",
            ),
            Row(
                "number density",
                "Bodhaine et al. 1999",
                2.546899e25,
                air.number_density,
                tolerance=2e-5 * 2.546899e25,
                unit="1/m3",
            ),
            Row(
                "extinction at 532 nm",
                "5.167e-27 cm2 times 2.546899e19 / cm3",
                1.31598e-5,
                air.extinction,
                tolerance=3e-4 * 1.316e-5,
                unit="1/m",
            ),
        ),
    )


CHECKS = (cross_sections, refraction, depolarisation, density)
