"""The etalon: orders, fringes, mirrors, plate defects.

Fringes are compared with Airy's formula and its averages by quadrature (1e-9), orders with
arithmetic of 40 digits (1e-9 orders, 2e-6 m/s), coated plates with an independent transfer-matrix
code (1e-9 of whole stacks) and the conservation of energy (1e-12), finesse with published formulas.
"""

import math

import mpmath
import numpy as np
import pytest
import tmm
from pydantic import ValidationError
from scipy import constants, integrate

from lidar_mi.atmosphere.scattering.line import backscatter_line, laser_line
from lidar_mi.errors import InputError
from lidar_mi.instrument.etalon import (
    Etalon,
    coated_transmission,
    finesse,
    fractional_order,
    harmonics,
    mirrors,
    plate_defects,
    transmission,
)

WAVELENGTH = 354.7e-9
ETALON = Etalon()
PERFECT = Etalon(surface_rms=0)
AIR = backscatter_line(WAVELENGTH, 232.9, 33154.0, aerosol_fraction=0.2)
HIGH, LOW = (2.1, WAVELENGTH / 4 / 2.1), (1.48, WAVELENGTH / 4 / 1.48)
# not at all quarter waves, and one layer that absorbs
ODD = ((2.1, 61e-9), (1.48, 40e-9), (2.3, 35e-9, 0.02), (1.48, 77e-9))
QUARTERS = (HIGH, LOW, HIGH, LOW, HIGH)
OFFSETS = np.array([-7e9, -1.3e9, 0.0, 0.4e9, 2e9, 5.6e9])
# angles of a ring image, the largest that of the default image's corners
ANGLES = [0.0, 3.6e-3, 0.0153]


def airy(order, reflectivity=0.7, absorption=0.0):
    peak = (1 - reflectivity - absorption) ** 2 / (1 - reflectivity) ** 2
    coefficient = 4 * reflectivity / (1 - reflectivity) ** 2
    return peak / (1 + coefficient * np.sin(np.pi * order) ** 2)


# orders


def test_default_orders():
    assert ETALON.order_at_centre(WAVELENGTH) == 77248.5
    assert ETALON.tuned_gap(WAVELENGTH) == pytest.approx(13.7e-3, abs=WAVELENGTH / 4)
    assert ETALON.free_spectral_range(WAVELENGTH) == pytest.approx(10.94e9, rel=2e-4)


def test_gap_that_is_not_tuned():
    etalon = Etalon(order_fraction=None)
    assert etalon.tuned_gap(WAVELENGTH) == pytest.approx(13.7e-3, rel=1e-15)
    assert etalon.order_at_centre(WAVELENGTH) == pytest.approx(2 * 13.7e-3 / WAVELENGTH, rel=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("v", [-300.0, 0.0, 50.0])
@pytest.mark.parametrize("index", [1.0, 1.476])
def test_fractional_order_to_forty_digits(angle, v, index):
    """2 n d nu cos(theta) / c less 77248, or less 114018 in a solid etalon."""
    etalon = Etalon(index=index)
    offset = 2 * v / WAVELENGTH
    with mpmath.workdps(40):
        order = mpmath.mpf(etalon.order_at_centre(WAVELENGTH))
        nu = constants.c / mpmath.mpf(WAVELENGTH)
        cosine = mpmath.mpf(math.cos(angle))
        expected = order * (nu + offset) / nu * cosine - mpmath.floor(order)
    found = fractional_order(etalon, WAVELENGTH, math.cos(angle), offset)
    assert float(found) == pytest.approx(float(expected), abs=1e-9)


# fringes


@pytest.mark.parametrize("absorption", [0.0, 0.05])
@pytest.mark.parametrize("reflectivity", [0.2, 0.7, 0.94])
def test_series_is_airys_formula(reflectivity, absorption):
    etalon = Etalon(surface_rms=0, reflectivity=reflectivity, absorption=absorption)
    offset = np.linspace(-12e9, 12e9, 97)
    order = 0.5 + offset / etalon.free_spectral_range(WAVELENGTH)
    found = transmission(etalon, WAVELENGTH, 1.0, offset)
    np.testing.assert_allclose(found, airy(order, reflectivity, absorption), atol=1e-9)


def test_mean_transmission_is_that_of_incoherent_reflections():
    """Without interference: T^2 (1 + R^2 + R^4 + ...)."""
    mean = sum(0.3**2 * 0.7 ** (2 * k) for k in range(100))
    assert harmonics(PERFECT, WAVELENGTH)[0] == pytest.approx(mean, rel=1e-12)


@pytest.mark.parametrize("line", [AIR, AIR.shifted(0.7e9), laser_line(WAVELENGTH, 100e6)])
def test_transmission_of_a_line_by_quadrature(line):
    nu = np.linspace(-16e9, 16e9, 40_001)
    density = line.pdf(nu)
    offsets = np.linspace(-6e9, 6e9, 13)
    order = 0.5 + (offsets[:, None] + nu) / PERFECT.free_spectral_range(WAVELENGTH)
    expected = integrate.simpson(density * airy(order), x=nu)
    found = transmission(PERFECT, WAVELENGTH, 1.0, offsets, line)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_irregular_plates_by_quadrature():
    """Gaps of 2 nm standard deviation: a fringe a gap, averaged."""
    gaps = np.linspace(-8, 8, 4001) * 2e-9
    weight = np.exp(-(gaps**2) / 2 / 2e-9**2) / math.sqrt(2 * math.pi) / 2e-9
    order = np.linspace(0, 1, 21)
    many = airy(order[:, None] + 2 * gaps / WAVELENGTH)
    expected = integrate.simpson(weight * many, x=gaps)
    offset = (order - 0.5) * ETALON.free_spectral_range(WAVELENGTH)
    np.testing.assert_allclose(transmission(ETALON, WAVELENGTH, 1.0, offset), expected, atol=1e-9)


def test_bow_by_quadrature_over_the_aperture():
    """A spherical plate's gap, 12 nm more in the middle than at the rim, over a disc."""
    radius = np.linspace(0, 1, 4001)
    gap = 12e-9 * (0.5 - radius**2)
    order = np.linspace(0, 1, 21)
    many = airy(order[:, None] + 2 * 1.3 * gap / WAVELENGTH)
    expected = integrate.simpson(2 * radius * many, x=radius)
    bowed = Etalon(surface_rms=0, bow="12 nm", index=1.3)
    offset = (order - 0.5) * bowed.free_spectral_range(WAVELENGTH)
    np.testing.assert_allclose(transmission(bowed, WAVELENGTH, 1.0, offset), expected, atol=1e-9)
    assert plate_defects(bowed, WAVELENGTH, 0) == 1


def test_finesse():
    """Finesse pi R^(1/2) / (1 - R) = 8.76 for narrow fringes (Born & Wolf, sect. 7.6).

    For all fringes pi / 2 / arcsin((1 - R) / (2 R^(1/2))).
    """
    exact = math.pi / 2 / math.asin(0.3 / 2 / math.sqrt(0.7))
    assert finesse(PERFECT, WAVELENGTH) == pytest.approx(exact, rel=1e-9)
    assert exact == pytest.approx(math.pi * math.sqrt(0.7) / 0.3, rel=6e-3)
    assert finesse(ETALON, WAVELENGTH, laser_line(WAVELENGTH, 100e6)) == pytest.approx(
        8.2, abs=0.05
    )


def test_no_finesse_of_weak_mirrors():
    with pytest.raises(InputError, match="nowhere fall to half"):
        finesse(Etalon(reflectivity=0.1), WAVELENGTH)


# coatings


def coated(layers, **changes):
    return Etalon(coatings=layers, surface_rms=0, **changes)


def whole_stack(etalon, angle, offset, polarization):
    """Plate, coating, gap, coating, plate by an independent code; angle inside the gap."""
    layers = [(n + 1j * k, d) for n, d, k in etalon.coatings]
    gap = (etalon.index, etalon.tuned_gap(WAVELENGTH))
    inner = [*layers, gap, *reversed(layers)]
    indices = [etalon.plate_index, *(n for n, _ in inner), etalon.plate_index]
    thicknesses = [np.inf, *(d for _, d in inner), np.inf]
    outside = math.asin(etalon.index * math.sin(angle) / etalon.plate_index)
    wavelength = 1 / (1 / WAVELENGTH + offset / constants.c)
    return tmm.coh_tmm(polarization, indices, thicknesses, outside, wavelength)


@pytest.mark.parametrize("polarization", ["s", "p"])
@pytest.mark.parametrize("angle", [*ANGLES, 0.4])
@pytest.mark.parametrize("layers", [QUARTERS, ODD])
def test_coated_etalon_by_another_code(layers, angle, polarization):
    etalon = coated(layers, index=1.2)
    stacks = [whole_stack(etalon, angle, offset, polarization) for offset in OFFSETS]
    arguments = (etalon, WAVELENGTH, math.cos(angle), OFFSETS, polarization)
    through = coated_transmission(*arguments)
    np.testing.assert_allclose(through, [s["T"] for s in stacks], atol=2e-9)
    # one of the stacks absorbs
    lost = [sum(tmm.absorp_in_each_layer(s)[1:-1]) for s in stacks]
    assert (max(lost) > 1e-3) == (layers is ODD)


@pytest.mark.parametrize("polarization", ["s", "p"])
@pytest.mark.parametrize("layers", [QUARTERS, ODD])
def test_series_holds_for_coated_mirrors_in_a_ring_image(layers, polarization):
    """To 4e-4 of full transmission, out to the fourth ring (9.5 mrad)."""
    etalon = coated(layers)
    cosine = np.cos(np.linspace(0, 9.6e-3, 400))[:, None]
    exact = coated_transmission(etalon, WAVELENGTH, cosine, OFFSETS, polarization)
    np.testing.assert_allclose(transmission(etalon, WAVELENGTH, cosine, OFFSETS), exact, atol=4e-4)
    assert np.ptp(exact) > 0.5


@pytest.mark.parametrize("layers", [QUARTERS, ODD])
def test_tuned_gap_takes_the_coatings_phase_into_account(layers):
    """Order at the centre half way between fringes: darkest there, brightest half an FSR off."""
    etalon = coated(layers)
    half = etalon.free_spectral_range(WAVELENGTH) / 2
    near = np.array([-0.02, 0, 0.02]) * half
    dark = coated_transmission(etalon, WAVELENGTH, 1.0, near)
    bright = coated_transmission(etalon, WAVELENGTH, 1.0, near + half)
    assert dark.argmin() == 1 and bright.argmax() == 1
    assert abs(etalon.tuned_gap(WAVELENGTH) - 13.7e-3) <= WAVELENGTH / 4 * (1 + 1e-6)


def test_mirror_of_quarter_waves():
    """((n_H^2N+2 / n_L^2N - n_plate) / (... + n_plate))^2 (Born & Wolf, sect. 1.6.5)."""
    admittance = 2.1**6 / 1.48**4 / 1.476
    mirror = mirrors(coated(QUARTERS), WAVELENGTH)
    assert mirror.reflectance == pytest.approx(((admittance - 1) / (admittance + 1)) ** 2, rel=1e-9)
    assert mirror.transmittance == pytest.approx(1 - mirror.reflectance, rel=1e-9)
    assert mirror.order_shift == pytest.approx(0, abs=1e-9)


# bad input


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"gap": 0}, "gap"),
        ({"reflectivity": 1.0}, "reflectivity"),
        ({"reflectivity": 0.9, "absorption": 0.1}, "absorption: 0.1 is not allowed with reflec"),
        ({"order_fraction": 1.0}, "order_fraction"),
        ({"coatings": ()}, "coatings"),
        ({"coatings": ((2.1, -1e-9),)}, r"coatings: \(2.1, -1e-09, 0.0\) is not allowed"),
        ({"coatings": ((0.5, 1e-9),)}, "an index of 1 to 10"),
        ({"finesse": 30}, "finesse"),
    ],
)
def test_bad_descriptions(changes, words):
    with pytest.raises(ValidationError, match=words):
        Etalon(**changes)


def test_coating_that_does_not_transmit():
    opaque = coated((HIGH, LOW) * 25)
    for call in (opaque.order_at_centre, lambda x: harmonics(opaque, x)):
        with pytest.raises(InputError, match=r"mirror that transmits .* expected at least 1e-06"):
            call(WAVELENGTH)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: coated_transmission(ETALON, WAVELENGTH, 1.0), "etalon.coatings: null"),
        (lambda: coated_transmission(coated(ODD), WAVELENGTH, 1, 0, "x"), "'x'.* expected s or p"),
        (
            lambda: harmonics(Etalon(reflectivity=0.999999), WAVELENGTH),
            "0.999999 need .* harmonics",
        ),
        (lambda: ETALON.order_at_centre(-1.0), "wavelength: -1.0 m"),
    ],
)
def test_bad_calls(call, words):
    with pytest.raises(InputError, match=words):
        call()


def test_lengths_of_layers_with_units():
    etalon = Etalon(coatings=[["2.1", "42 nm"], [1.48, 6e-8]])
    assert etalon.coatings[0].thickness == pytest.approx(42e-9)
