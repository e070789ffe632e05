"""Errors that no image shows: closed forms against quadrature over the pupil made without them.

Detects: a term of the wrong size by 1e-6, terms that are not independent, a scrambling that does
not lead to the limit asked for.
"""

import math

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.reference_error import Filling, ReferenceUncertainty
from validation.fringe_reference import LIGHT, Defects, Instrument, Light, pupil_orders

NOMINAL = Instrument()
KNOWN = {"wavelength": NOMINAL.wavelength, "gap": NOMINAL.gap}
RMS = NOMINAL.wavelength / 100


def mean_speed(defects: Defects, light: Light) -> float:
    """Speed that shifts the rings as the gap's mean over the light does, m/s."""
    orders, weights = pupil_orders(NOMINAL, defects, light)
    return (weights @ orders) * LIGHT / 2 / (2 * NOMINAL.gap / NOMINAL.wavelength)


@pytest.mark.parametrize("kind", ["bow", "wedge"])
@pytest.mark.parametrize("radius, shift", [(0.5, 0.0), (1.0, 0.05), (0.7, -0.2)])
def test_plates_times_pupil_is_the_mean_gap(kind, radius, shift):
    """Bow and wedge: to the rounding of a quadrature that is exact for polynomials."""
    defects = Defects(**{kind: RMS})
    light = Light(pupil=radius, pupil_shift=shift)
    expected = abs(mean_speed(defects, Light()) - mean_speed(defects, light))
    known = ReferenceUncertainty(**KNOWN, **{kind: RMS}, laser=Filling(radius, shift))
    assert known.terms()[f"{kind} and pupil"] == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert known.total == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_sizes_of_a_real_instrument():
    """Half the radius of plates bowed by lambda/100 rms: 50 m/s; 10 MHz: 1.77 m/s; 1 K: 75 m/s."""
    half = ReferenceUncertainty(**KNOWN, bow=RMS, laser=Filling(0.5))
    assert half.total == pytest.approx(50.4, abs=0.1)
    assert ReferenceUncertainty(**KNOWN, laser_drift=10e6).total == pytest.approx(1.7735, abs=1e-4)
    assert ReferenceUncertainty(**KNOWN, etalon_drift=1.0).total == pytest.approx(74.95, abs=0.01)


def test_terms_are_independent():
    known = ReferenceUncertainty(
        **KNOWN, laser_drift=1e6, etalon_drift=1e-3, bow=1e-11, wedge=2e-11, laser=Filling(0.8, 0.1)
    )
    terms = known.terms()
    assert min(terms.values()) > 0.01
    assert known.total == pytest.approx(np.sqrt(sum(v**2 for v in terms.values())), rel=1e-12)


def test_scrambled_light_is_a_mixture_with_an_even_pupil():
    defects, light = Defects(bow=RMS, wedge=RMS), Light(pupil=0.6, pupil_shift=0.1)
    uneven, even = mean_speed(defects, light), mean_speed(defects, Light())
    mixed = 0.3 * even + 0.7 * uneven
    known = ReferenceUncertainty(
        **KNOWN, bow=RMS, wedge=RMS, laser=Filling(0.6, 0.1), scrambling=0.3
    )
    bow, wedge = (known.terms()[f"{kind} and pupil"] for kind in ("bow", "wedge"))
    # here their signs are opposite
    assert abs(bow - wedge) == pytest.approx(abs(mixed - even), rel=1e-9)


def test_how_well_light_must_be_scrambled():
    known = ReferenceUncertainty(**KNOWN, laser_drift=1e6, bow=RMS, laser=Filling(0.5))
    factor = known.scrambling_for(0.5)
    # of 50.4 m/s remain (0.5^2 - 0.177^2)^(1/2)
    assert factor == pytest.approx(1 - math.sqrt(0.25 - 0.17735**2) / 50.4, abs=1e-4)
    assert ReferenceUncertainty(
        **KNOWN, laser_drift=1e6, bow=RMS, laser=Filling(0.5), scrambling=factor
    ).total == pytest.approx(0.5, rel=1e-9)
    assert known.scrambling_for(100.0) == 0
    assert ReferenceUncertainty(**KNOWN).scrambling_for(0.0) == 0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"gap": 0.0}, "gap: 0.0 is not allowed; expected above 0"),
        ({"bow": -1e-9}, "bow: -1e-09 is not allowed; expected 0 or more"),
        ({"laser_drift": math.nan}, "laser_drift: nan is not allowed; expected 0 or more"),
        ({"scrambling": 1.5}, "scrambling: 1.5 is not allowed; expected 0 to 1"),
    ],
)
def test_numbers_that_cannot_be(change, message):
    with pytest.raises(InputError, match=message):
        ReferenceUncertainty(**{**KNOWN, **change})


def test_limits_and_fillings_that_cannot_be():
    with pytest.raises(InputError, match=r"limit: 0.5 m/s .* at least 1.77 m/s"):
        ReferenceUncertainty(**KNOWN, laser_drift=10e6).scrambling_for(0.5)
    with pytest.raises(InputError, match="filling: radius 0"):
        Filling(0.0)
