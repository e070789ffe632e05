"""The Michelson interferometer: fringes by the sum of two waves, light that neither output loses.

Detects 1e-12 of the light lost or gained, a contrast off by 1e-9, a phase of the wrong sign, an
element that samples where it should average.
"""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import constants, integrate

from lidar_mi.atmosphere.scattering.line import backscatter_line
from lidar_mi.instrument.michelson import Michelson, harmonics, transmission

OFFSETS = np.array([-7e9, -1.3e9, 0.0, 0.4e9, 2e9, 5.6e9])
AIR = backscatter_line(354.7e-9, 232.9, 33154.0, aerosol_fraction=0.2)
# so many elements that each is a point of the fringe
FINE = {"elements": 4000, "contrast": 1.0}


def two_waves(interferometer, offset, order):
    """Intensities of both outputs: amplitudes of a splitter of phase i, and a delayed arm."""
    r, t = (math.sqrt(x) for x in (reflectance(interferometer), 1 - reflectance(interferometer)))
    phase = 2 * math.pi * (offset * interferometer.path_difference / constants.c + order)
    arm = np.exp(1j * phase)
    # both arms arrive in phase where the order is an integer
    forward = t * r * (1 + arm)
    back = t * t - r * r * arm
    return abs(forward) ** 2, abs(back) ** 2


def reflectance(interferometer):
    return interferometer.splitter_reflectance


@pytest.mark.parametrize("splitter", [0.5, 0.37])
def test_fringes_are_those_of_two_waves(splitter):
    found = Michelson(splitter_reflectance=splitter, order_fraction=0.2, fringes=1.3, **FINE)
    order = 0.2 + 1.3 * (np.arange(4000) + 0.5) / 4000
    expected = np.concatenate(two_waves(found, OFFSETS, order[:, None])) / 4000
    np.testing.assert_allclose(4000 * transmission(found, OFFSETS), 4000 * expected, atol=1e-6)


@pytest.mark.parametrize("changes", [{}, {"splitter_reflectance": 0.3, "contrast": 0.6}])
def test_both_outputs_together_lose_nothing(changes):
    found = transmission(Michelson(**changes), OFFSETS)
    np.testing.assert_allclose(found.sum(0), 1, rtol=1e-12)
    lossy = transmission(Michelson(transmittance=0.7, **changes), OFFSETS)
    np.testing.assert_allclose(lossy, 0.7 * found, rtol=1e-12)
    one = transmission(Michelson(outputs=1, **changes), OFFSETS)
    np.testing.assert_array_equal(one, found[: len(one)])


def test_element_averages_the_fringe():
    wide = Michelson(elements=5, fringes=2.0, contrast=0.8)
    for k in range(5):
        low, high = 2 * k / 5, 2 * (k + 1) / 5

        def fringe(order):
            return 0.5 * (1 + 0.8 * math.cos(2 * math.pi * order))

        expected = integrate.quad(fringe, low, high, epsabs=1e-13)[0] / 2
        assert transmission(wide, 0.0)[k] == pytest.approx(expected, abs=1e-12)


def test_fringe_of_a_line_by_quadrature():
    """Contrast and phase of air that moves at 60 m/s: product with the characteristic function."""
    line, interferometer = AIR.shifted(2 * 60 / 354.7e-9), Michelson(elements=7)
    nu = np.linspace(-16e9, 16e9, 40_001)
    expected = integrate.simpson(line.pdf(nu) * transmission(interferometer, nu), x=nu)
    constant, cosine = harmonics(interferometer).T
    chi = line.characteristic(interferometer.delay)
    np.testing.assert_allclose(constant.real + 2 * (cosine * chi).real, expected, atol=1e-9)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"path_difference": 0}, "path_difference"),
        ({"contrast": 1.2}, "contrast"),
        ({"splitter_reflectance": 1.0}, "splitter_reflectance"),
        ({"outputs": 3}, "outputs"),
        ({"elements": 2}, "elements"),
        ({"finesse": 3}, "finesse"),
    ],
)
def test_bad_descriptions(changes, words):
    with pytest.raises(ValidationError, match=words):
        Michelson(**changes)
