"""The double edge: two filters by Airy's formula, and the light that they share.

Detects 1e-9 of transmission, peaks in the wrong place, light counted twice.
"""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import constants, integrate

from lidar_mi.instrument.double_edge import DoubleEdge, harmonics, transmission
from lidar_mi.instrument.etalon import Etalon

WAVELENGTH = 354.7e-9
PERFECT = Etalon(gap=12.5e-3, reflectivity=0.64, order_fraction=None, surface_rms=0)
OFFSETS = np.linspace(-9e9, 9e9, 61)
SPECTRAL_RANGE = constants.c / (2 * 12.5e-3)


def airy(offset, peak, tilt=0.0):
    """Lossless mirrors of 0.64, the order less by ``tilt``."""
    order = (offset - peak) / SPECTRAL_RANGE - tilt
    return 1 / (1 + 4 * 0.64 / 0.36**2 * np.sin(np.pi * order) ** 2)


def ideal(**changes):
    return DoubleEdge(etalon=PERFECT, field_half_angle=0, **changes)


def test_split_filters_are_airys_formula():
    found = transmission(ideal(spacing="5.1 GHz"), WAVELENGTH, OFFSETS)
    expected = [airy(OFFSETS, peak) / 2 for peak in (-2.55e9, 2.55e9)]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_second_filter_of_a_sequence_gets_what_the_first_reflects():
    receiver = ideal(spacing="4.4 GHz", arrangement="sequential", transmittance=0.8)
    first, second = (airy(OFFSETS, peak) for peak in (-2.2e9, 2.2e9))
    expected = 0.8 * np.stack([first, (1 - first) * second])
    found = transmission(receiver, WAVELENGTH, OFFSETS)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (found.sum(0) <= 0.8 + 1e-9).all() and found.sum(0).max() > 0.6


def full_width(receiver):
    peak = transmission(receiver, WAVELENGTH, np.array([-2.55e9]))[0]
    offset = np.linspace(-2.55e9, 0, 20_001)
    below = offset[transmission(receiver, WAVELENGTH, offset)[0] < peak / 2][0]
    return 2 * (below + 2.55e9)


def test_width_of_the_default_filters():
    """FSR 2 / pi arcsin((1 - R) / (2 R^1/2)) = 1.7 GHz; plates and field make it 1.8 GHz."""
    assert 1 / DoubleEdge().delay(WAVELENGTH) == pytest.approx(12e9, rel=2e-3)
    exact = SPECTRAL_RANGE * 2 / math.pi * math.asin(0.36 / 2 / 0.8)
    assert full_width(ideal()) == pytest.approx(exact, rel=1e-3)
    assert full_width(DoubleEdge()) == pytest.approx(1.84e9, rel=5e-3)


def test_field_by_quadrature_over_its_directions():
    """A disc of 3 mrad, in solid angle; the mean direction is tuned to the peak."""
    receiver = DoubleEdge(etalon=PERFECT, field_half_angle="3 mrad")
    order = 2 * 12.5e-3 / WAVELENGTH
    tilt = order * (1 - np.cos(np.sqrt(np.linspace(0, 1, 8001)) * 3e-3))
    many = airy(OFFSETS[:, None], -2.55e9, tilt.mean() - tilt)
    expected = integrate.simpson(many / 2, x=np.linspace(0, 1, 8001))
    # the angle to fourth order: m a^4 / 24
    found = transmission(receiver, WAVELENGTH, OFFSETS)[0]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_harmonics_of_a_real_series():
    for arrangement in ("split", "sequential"):
        found = harmonics(DoubleEdge(arrangement=arrangement), WAVELENGTH)
        assert found.shape[0] == 2 and abs(found[:, 0].imag).max() < 1e-15
    # all the light falls on the first of a sequence
    assert found[0, 0].real == pytest.approx(harmonics(DoubleEdge(), WAVELENGTH)[0, 0].real * 2)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"spacing": 0}, "spacing"),
        ({"arrangement": "mixed"}, "arrangement"),
        (
            {"arrangement": "sequential", "etalon": Etalon(absorption=0.01)},
            "sequential is not allowed with absorption",
        ),
        ({"transmittance": 0}, "transmittance"),
        ({"field_half_angle": 1}, "field_half_angle"),
    ],
)
def test_bad_descriptions(changes, words):
    with pytest.raises(ValidationError, match=words):
        DoubleEdge(**changes)
