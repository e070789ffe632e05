"""Named aerosols: unit tests. Detect an index or a size distribution other than the published one,
and any impossible aerosol accepted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.atmosphere.scattering.aerosols import (
    AEROSOLS,
    Aerosol,
    LogNormal,
    ModifiedGamma,
    changed,
)
from lidar_mi.atmosphere.scattering.particle_scattering import make_table
from lidar_mi.errors import InputError

GREEN = 532e-9


def test_omitted_fraction_in_closed_form():
    """Area is log-normal too, about median exp(2 ln^2 sigma): a normal tail."""
    sizes = LogNormal(0.2e-6, 1.7, 0.03e-6, 1.5e-6)
    spread = math.log(1.7)

    def below(radius):
        centred = math.log(radius / 0.2e-6) - 2 * spread**2
        return 0.5 * math.erfc(-centred / (spread * math.sqrt(2)))

    expected = below(0.03e-6) + 1 - below(1.5e-6)
    made = Aerosol("a", "t", sizes, ((GREEN, 1.5),)).area_left_out()
    assert made == pytest.approx(expected, rel=1e-6)


def test_modified_gamma_is_deirmendjians():
    """C.1: n(r) = 2.373 r^6 exp(-1.5 r) per cm^3 and um holds 100 droplets; the mode is 4 um."""
    sizes = AEROSOLS["droplets"].sizes
    radius = np.linspace(0.5, 15, 50)
    expected = 2.373 * radius**6 * np.exp(-1.5 * radius)
    got = sizes(radius * 1e-6)
    np.testing.assert_allclose(got / got[10], expected / expected[10], rtol=1e-10)
    fine = np.linspace(3, 5, 2001)
    assert fine[sizes(fine * 1e-6).argmax()] == pytest.approx(4.0)


SIZES = LogNormal(0.2e-6, 1.7, 0.03e-6, 1e-6)
INDEX = ((GREEN, 1.5 + 0.01j),)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: make_table("smoke", GREEN), "'smoke' is not known; expected one of continental"),
        (lambda: make_table("spheres", 1.6e-6), "1600 nm .*'spheres'.* 355 to 1550 nm"),
        (lambda: Aerosol("a", "t", replace(SIZES, sigma=0.9), INDEX), "sigma: 0.9"),
        (lambda: Aerosol("a", "t", replace(SIZES, median=-1.0), INDEX), "median: -1.0"),
        (lambda: Aerosol("a", "t", replace(SIZES, largest=1e-8), INDEX), "radii from"),
        (lambda: Aerosol("a", "t", ModifiedGamma(1e-6, 0, 1, 1e-7, 1e-5), INDEX), "alpha: 0"),
        (lambda: Aerosol("a", "t", SIZES, INDEX, elongation=0.5), "elongation: 0.5.*1 .sphere"),
        (lambda: Aerosol("a", "t", SIZES, INDEX, number_density=0), "number_density: 0"),
        (lambda: Aerosol("a", "t", SIZES, ()), "wavelengths"),
        (lambda: Aerosol("a", "t", SIZES, ((GREEN, 1.5 - 0.1j),)), "imaginary part >= 0"),
    ],
)
def test_bad_input(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_refractive_index_is_linear_between_wavelengths():
    m = AEROSOLS["continental"].refractive_index((355e-9 + 532e-9) / 2)
    assert m == pytest.approx(1.53 + 0.0055j, rel=1e-12)


# Hess, Koepke & Schult 1998 (OPAC), as ECMWF's aerosol optics code tabulates it: um, real,
# imaginary. The dust-like component is called insoluble there; sea salt at 80 % humidity.
OPAC = {
    "spheres": (
        (0.35, 1.53, 8e-3),
        (0.5, 1.53, 8e-3),
        (0.55, 1.53, 8e-3),
        (1.0, 1.52, 8e-3),
        (1.25, 1.46, 8e-3),
        (1.5, 1.41, 8e-3),
        (1.75, 1.34, 8e-3),
    ),
    "continental": (
        (0.35, 1.53, 5e-3),
        (0.5, 1.53, 5e-3),
        (0.55, 1.53, 6e-3),
        (1.0, 1.52, 1.55e-2),
        (1.25, 1.51, 1.9e-2),
    ),
    "soot": (
        (0.35, 1.75, 0.465),
        (0.4, 1.75, 0.46),
        (0.5, 1.75, 0.45),
        (0.55, 1.75, 0.44),
        (1.0, 1.76, 0.44),
        (1.25, 1.76, 0.45),
    ),
    "sea_salt": (
        (0.35, 1.364, 4.7e-8),
        (0.5, 1.356, 2.8e-9),
        (0.55, 1.354, 3.0e-9),
        (1.0, 1.345, 2.0e-5),
        (1.25, 1.342, 5.3e-5),
    ),
}


@pytest.mark.parametrize(
    ("name", "wavelength"),
    [(name, w) for name in OPAC for w in (355e-9, 532e-9, 1064e-9)] + [("spheres", 1550e-9)],
)
def test_indices_are_the_published_ones(name, wavelength):
    """Linear between OPAC's wavelengths: real parts to 0.02, imaginary to 10 %, of salt to 1e-5.

    Dust falls between 1 and 1.25 um, where its index is not known better.
    """
    micrometres, real, imaginary = zip(*OPAC[name], strict=True)
    m = AEROSOLS[name].refractive_index(wavelength)
    assert m.real == pytest.approx(np.interp(wavelength * 1e6, micrometres, real), abs=0.02)
    expected = np.interp(wavelength * 1e6, micrometres, imaginary)
    assert m.imag == pytest.approx(expected, rel=0.1, abs=1e-5 if name == "sea_salt" else 0)


def test_a_changed_aerosol_keeps_the_rest():
    one = changed("dust", GREEN, "ash", index=1.6 + 0.01j, sigma=1.5, largest=1e-6)
    dust = AEROSOLS["dust"]
    assert one.refractive_index(GREEN) == 1.6 + 0.01j
    assert (one.sizes.median, one.sizes.sigma, one.sizes.largest) == (0.3e-6, 1.5, 1e-6)
    assert (one.elongation, one.number_density) == (dust.elongation, dust.number_density)
    assert changed("dust", GREEN) is dust
    gamma = changed("droplets", GREEN, "fog", radius=2e-6)
    assert gamma.sizes == replace(AEROSOLS["droplets"].sizes, mode=2e-6)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"sigma": 2.0}, "name: None is not allowed for a changed 'droplets'|sigma"),
        ({"new_name": "fog", "sigma": 2.0}, "sigma: 2 is not allowed; the sizes of 'droplets'"),
        ({"new_name": "dust", "radius": 1e-6}, "name: dust is not allowed"),
        ({"radius": 1e-6}, "name: None is not allowed"),
        ({"new_name": "fog", "radius": -1.0}, "mode: -1.0 is not allowed"),
        ({"new_name": "fog", "elongation": 9.0}, "elongation: 9.0 is not allowed"),
        ({"new_name": "fog", "index": 0.0}, "index: 0.0 is not allowed"),
    ],
)
def test_a_change_that_makes_no_aerosol_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        changed("droplets", GREEN, **changes)
