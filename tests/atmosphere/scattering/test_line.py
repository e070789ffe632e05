"""The backscattered line: widths, shapes, shifts.

Widths are compared with those of the paper's air (354.7 nm, 8500 m; 3 digits), the Doppler shift
with relativity (1e-6), the Rayleigh-Brillouin fit with kinetic theory (1 % of the width), with what
collisions cannot change and with the limits of no and many collisions (1.5 % of the rms, the fit's
own error), the Fourier transform with quadrature (1e-9), samples with their distribution
(Kolmogorov-Smirnov).
"""

import itertools
import math

import numpy as np
import pytest
from fluids.atmosphere import ATMOSPHERE_1976
from scipy import constants, integrate, stats

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.atmosphere.scattering.line import (
    Line,
    backscatter_line,
    laser_line,
    rayleigh,
    rayleigh_brillouin,
    rayleigh_width,
    viscosity,
)
from lidar_mi.errors import InputError

WAVELENGTH = 354.7e-9
PRESSURE, TEMPERATURE, _ = standard_atmosphere(8500.0)
# one standard deviation of the thermal Doppler shift, 2 v0 / wavelength, and the unit of x
THERMAL = 2 / WAVELENGTH * math.sqrt(constants.R * TEMPERATURE / 28.9644e-3)
# y = p wavelength / (4 pi 2^(1/2) v0 eta), so this many Pa are y = 1
ONE = 4 * math.pi * math.sqrt(2) * THERMAL / 2 * viscosity(TEMPERATURE)


def variance(line):
    return line.weights @ (line.sigmas**2 + (line.offsets - line.mean) ** 2)


def test_widths_of_the_papers_air():
    assert (PRESSURE, TEMPERATURE) == (pytest.approx(331.5e2, 1e-3), pytest.approx(232.9, abs=0.1))
    assert rayleigh_width(WAVELENGTH, 232.9) == pytest.approx(3.43e9, rel=2e-3)
    assert rayleigh(WAVELENGTH, 232.9).width == pytest.approx(3.43e9, rel=2e-3)
    assert rayleigh_brillouin(WAVELENGTH, 232.9, PRESSURE).width == pytest.approx(3.68e9, rel=2e-3)


def test_rayleigh_line_is_the_doppler_shift_of_a_maxwellian():
    assert rayleigh_width(WAVELENGTH, TEMPERATURE) == pytest.approx(2.354820 * THERMAL, rel=1e-6)


@pytest.mark.parametrize("altitude", [0.0, 8500.0, 30e3])
def test_viscosity(altitude):
    air = ATMOSPHERE_1976(altitude)
    assert viscosity(air.T) == pytest.approx(air.mu, rel=1e-6)


def relaxing_gas(frequency, y, freedoms=5):
    """Spectrum of density fluctuations by the Boltzmann equation with BGK collisions.

    Frequency in k v0. Molecules relax to the local equilibrium (density, flow, temperature) at the
    rate p / eta = 2^(1/2) y: the Laplace transform of the density that starts as a wave solves
    three linear equations, whose coefficients are moments of a Maxwellian over rate + i (c -
    frequency).
    """
    rate = math.sqrt(2) * y
    c = np.linspace(-9, 9, 3001)
    maxwell = np.exp(-(c**2) / 2) / math.sqrt(2 * math.pi) * (c[1] - c[0])
    moment = (maxwell / (rate + 1j * (c - frequency[:, None]))) @ c[:, None] ** np.arange(5)
    i0, i1, i2, i3, i4 = moment.T
    # of density, flow and energy; the other freedoms' energy is independent of c
    heat, flux, both = (
        (i2 - i0) / 2,
        (i3 - i1) / 2,
        (i4 - 2 * i2 + i0) / 4 + (freedoms - 1) / 2 * i0,
    )
    response = np.array([[i0, i1, heat], [i1, i2, flux], [heat, flux, both]]).transpose(2, 0, 1)
    matrix = np.diag([1, 1, freedoms / 2]) - rate * response
    return np.linalg.solve(matrix, response[:, :, :1])[:, 0, 0].real / math.pi


@pytest.mark.parametrize("y", [0.05, 0.17, 0.5, 1.0])
def test_brillouin_widths_by_kinetic_theory(y):
    """Within 1 %, where a factor 2^(1/2) in y makes 2 to 3 % (0.17, 0.5); the shape at 8500 m."""
    frequency = np.linspace(0, 8, 2001)
    found = relaxing_gas(frequency, y)
    assert 2 * integrate.simpson(found, x=frequency) == pytest.approx(1, abs=1e-4)
    width = 2 * np.interp(-found[0] / 2, -found, frequency) * THERMAL
    line = rayleigh_brillouin(WAVELENGTH, TEMPERATURE, y * ONE)
    assert line.width == pytest.approx(width, rel=0.01)
    if y == 0.17:
        fitted = line.pdf(frequency * THERMAL) * THERMAL
        np.testing.assert_allclose(fitted, found, atol=0.0085 * found.max())


@pytest.mark.parametrize("y", [0.0, 0.1, 0.3, 0.6, 1.0])
def test_collisions_leave_the_second_moment_alone(y):
    """<omega^2> = k^2 k_B T / m of any classical ideal gas (Boon & Yip 1980, sect. 2.3).

    The fit may miss 0.85 % of the peak anywhere, and as much in the wings as makes 1.5 % of the
    rms.
    """
    line = rayleigh_brillouin(WAVELENGTH, TEMPERATURE, y * ONE)
    assert math.sqrt(variance(line)) == pytest.approx(THERMAL, rel=0.015)
    assert line.mean == pytest.approx(0, abs=1)
    assert line.weights.min() >= 0


def test_collisions_move_the_outer_peaks_to_the_speed_of_sound():
    """At y = 1, the end of the fit, within 10 % of +-2 (1.4)^(1/2) v0 / wavelength."""
    line = rayleigh_brillouin(WAVELENGTH, TEMPERATURE, ONE)
    assert line.offsets[[0, 2]] == pytest.approx(
        np.sqrt(1.4) * THERMAL * np.array([-1, 1]), rel=0.1
    )


@pytest.mark.parametrize("shape", ["rayleigh", "rayleigh_brillouin"])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
def test_laser_and_air_add_their_variances(shape, fraction):
    """Aerosol has the laser's, air both."""
    laser = 100e6 / 2.354820
    line = backscatter_line(WAVELENGTH, TEMPERATURE, PRESSURE, 100e6, fraction, shape)
    air = backscatter_line(WAVELENGTH, TEMPERATURE, PRESSURE, 0.0, 0.0, shape)
    assert variance(line) == pytest.approx(laser**2 + (1 - fraction) * variance(air), rel=1e-6)
    narrow = line.sigmas < 1.001 * laser
    assert line.weights[narrow].sum() == pytest.approx(fraction, abs=1e-12)


def test_width_of_the_emitted_line():
    assert laser_line(WAVELENGTH, 100e6).width == pytest.approx(100e6, rel=1e-6)
    assert laser_line(WAVELENGTH, 0.0).width == 0


def crooked():
    return Line(WAVELENGTH, [0.2, 0.5, 0.3], [-3e9, 0.5e9, 2e9], [0.3e9, 1e9, 0.5e9])


def test_density_integrates_to_one_about_the_mean():
    nu = np.linspace(-10e9, 10e9, 20_001)
    density = crooked().pdf(nu)
    assert integrate.simpson(density, x=nu) == pytest.approx(1, abs=1e-9)
    mean = integrate.simpson(density * nu, x=nu)
    assert crooked().mean == pytest.approx(mean, abs=10)
    # -0.6 + 0.25 + 0.6 GHz
    assert mean == pytest.approx(0.25e9, abs=10)


@pytest.mark.parametrize("t", [0.0, 0.05e-9, 0.2e-9, -0.2e-9])
def test_characteristic_by_quadrature(t):
    nu = np.linspace(-10e9, 10e9, 20_001)
    expected = integrate.simpson(crooked().pdf(nu) * np.exp(2j * np.pi * nu * t), x=nu)
    assert crooked().characteristic(t) == pytest.approx(expected, abs=1e-9)


def test_shift_turns_the_transform():
    t = np.array([[0.1e-9, 0.3e-9]])
    moved = crooked().shifted(1e9).characteristic(t)
    assert moved.shape == (1, 2)
    np.testing.assert_allclose(moved, crooked().characteristic(t) * np.exp(2j * np.pi * 1e9 * t))


def test_samples_follow_the_density():
    line = crooked()
    drawn = line.sample(np.random.default_rng(1), 50_000)

    def cdf(nu):
        return stats.norm.cdf((nu[:, None] - line.offsets) / line.sigmas) @ line.weights

    assert stats.kstest(drawn, cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: rayleigh_width(WAVELENGTH, -1.0), "temperature: -1 is not allowed; expected K ab"),
        (lambda: rayleigh_width(0.0, 233.0), "wavelength: 0"),
        (
            lambda: rayleigh_brillouin(WAVELENGTH, 233.0, 5e5),
            "y = pressure.*: 2.5.* expected 0 to 1",
        ),
        (lambda: rayleigh_brillouin(WAVELENGTH, 233.0, math.nan), "pressure: nan"),
        (lambda: backscatter_line(WAVELENGTH, 233.0, 3e4, shape="voigt"), "shape: 'voigt'.*rayl"),
        (
            lambda: backscatter_line(WAVELENGTH, 233.0, 3e4, aerosol_fraction=2),
            "aerosol_fraction: 2",
        ),
        (lambda: laser_line(WAVELENGTH, -1.0), "laser_width: -1"),
        (lambda: Line(WAVELENGTH, [0.5, 0.6], [0, 0], [1, 1]), "weights: 1.1 .*sum of 1"),
        (lambda: Line(WAVELENGTH, [1.5, -0.5], [0, 0], [1, 1]), r"weights: -0\.5"),
        (lambda: Line(WAVELENGTH, [1.0], [0.0], [-1.0]), "sigmas: -1"),
        (lambda: Line(WAVELENGTH, [1.0], [math.inf], [1.0]), "offsets: inf"),
        (lambda: Line(WAVELENGTH, [1.0], [0.0, 1.0], [1.0]), "as many weights as"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(InputError, match=words):
        call()


def test_information_of_a_line():
    """1 / sigma^2 of a Gaussian; of others by adaptive quadrature of the definition."""
    assert rayleigh(WAVELENGTH, TEMPERATURE).information == pytest.approx(THERMAL**-2, rel=1e-9)
    line = backscatter_line(WAVELENGTH, TEMPERATURE, PRESSURE, aerosol_fraction=0.1)

    def density(x):  # in GHz
        return float(line.pdf(1e9 * x)) * 1e9

    def information(x):
        slope = (density(x + 1e-5) - density(x - 1e-5)) / 2e-5
        return slope**2 / density(x)

    parts = [-9, -3, -0.5, -0.25, -0.1, -0.05, 0, 0.05, 0.1, 0.25, 0.5, 3, 9]
    expected = sum(
        integrate.quad(information, low, high, epsrel=1e-8)[0]
        for low, high in itertools.pairwise(parts)
    )
    assert line.information * 1e18 == pytest.approx(expected, rel=1e-6)
    assert line.shifted(3e9).information == pytest.approx(line.information, rel=1e-9)
    with pytest.raises(InputError, match=r"line.sigmas: 0 Hz"):
        _ = laser_line(WAVELENGTH, 0.0).information
