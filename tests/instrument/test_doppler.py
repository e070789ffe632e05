"""Photons, sunlight and speckle of the Doppler lidar.

Photon numbers are compared with the published ones (2 digits) and an integral over the range bin
(1 %), sunlight with a hand calculation (0.1 %), coherence times with closed forms (1e-6) and with
the integral over time of the field's correlation (1e-6), modes with simulated speckle (4 sigma of
4000 pulses: 9 %).
"""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import integrate

from lidar_mi.atmosphere.scattering.line import Line, backscatter_line
from lidar_mi.errors import InputError
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.instrument.doppler import (
    DopplerLidar,
    coherence_time,
    photons,
    solar_background,
    speckle_modes,
)
from lidar_mi.instrument.etalon import Etalon, harmonics
from lidar_mi.instrument.fringe_camera import FringeCamera, fringe_image

LIDAR = DopplerLidar()
ETALON = Etalon()
CAMERA = FringeCamera()
AIR = backscatter_line(LIDAR.wavelength, 232.97, 33154.0)
PIXELS = 960 * 780


# photons


@pytest.mark.parametrize("distance, published", [(76, 1.3e7), (56, 2.4e7)])
def test_published_photon_numbers(distance, published):
    assert float(f"{photons(DopplerLidar(range=distance)):.1e}") == published


@pytest.mark.parametrize("distance, fraction", [(76, 0.0044), (56, 0.0081)])
def test_photons_of_the_whole_bin(distance, fraction):
    """1 / r^2 and the transmittance integrated over the bin: more by (dr / r)^2 / 4."""

    def density(r):
        return math.exp(-2 * 2.7e-5 * r) / r**2

    whole = integrate.quad(density, distance - 5, distance + 5)[0] / (10 * density(distance))
    assert whole - 1 == pytest.approx(fraction, abs=2e-4)


def test_beam_and_gate_of_the_paper():
    """0.08 m wide on average of both ranges, a volume of 0.05 m^3, 67 ns."""
    widths = [DopplerLidar(range=r).beam_width for r in (56, 76)]
    assert np.mean(widths) == pytest.approx(0.08, abs=0.005)
    assert math.pi / 4 * np.mean(widths) ** 2 * 10 == pytest.approx(0.05, abs=0.006)
    assert LIDAR.gate_duration == pytest.approx(6.7e-8, abs=5e-10)


# sunlight


def test_solar_background_by_hand():
    """0.18 W/m2/sr/nm x 1 nm x 0.13 m2 x pi 1e-6 sr = 7.3513e-8 W; x 66.713 ns x 0.15 = 7.3563e-16
    J; a photon has 5.6004e-19 J."""
    assert solar_background(LIDAR, ETALON) == pytest.approx(1313.5, rel=1e-3)


def test_sunlight_behind_the_etalon():
    """Mean transmission of white light, (1 - R) / (1 + R)."""
    before = DopplerLidar(counted="before_etalon")
    expected = solar_background(LIDAR, ETALON) * 0.3 / 1.7
    assert solar_background(before, ETALON) == pytest.approx(expected, rel=1e-9)


# speckle


@pytest.mark.parametrize("order", [0.0, 0.2, 0.5])
def test_coherence_time_by_the_fields_correlation(order):
    """int |g(t)|^2 dt with g the transform of line times fringe: a sum of echoes of the line's own,
    each a round trip of the gap later."""
    amplitudes = harmonics(ETALON, LIDAR.wavelength)
    trip = 1 / ETALON.free_spectral_range(LIDAR.wavelength)
    t = np.arange(-4e-9, 4e-9, 2e-12)
    g = amplitudes[0] * AIR.characteristic(t)
    for n, a in enumerate(amplitudes[1:], start=1):
        turn = np.exp(2j * np.pi * n * order)
        g = g + a * (turn * AIR.characteristic(t + n * trip))
        g = g + a * (np.conj(turn) * AIR.characteristic(t - n * trip))
    expected = integrate.simpson(abs(g / g[len(t) // 2]) ** 2, x=t)
    assert t[len(t) // 2] == pytest.approx(0, abs=1e-20)
    assert coherence_time(ETALON, AIR, order) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_modes_in_time_by_simulated_speckle():
    """Random fields of the spectrum behind the etalon, their energy in 67 ns: variance 1 / M."""
    # so few pixels that each has one mode in space
    one = DopplerLidar(telescope_area=1e-9)
    random = np.random.default_rng(1)
    pulses, count, window = 4000, 8192, 4 * one.gate_duration
    nu = np.fft.fftfreq(count, window / count)
    order = nu / ETALON.free_spectral_range(one.wavelength)
    fringe = 1 / (1 + 4 * 0.7 / 0.3**2 * np.sin(np.pi * order) ** 2)
    spread = np.sqrt(AIR.pdf(nu) * fringe)
    inside = round(count * one.gate_duration / window)
    energies = []
    for _ in range(8):
        noise = random.standard_normal((2, pulses // 8, count))
        field = np.fft.fft(spread * (noise[0] + 1j * noise[1]))
        energies.append((abs(field[:, :inside]) ** 2).sum(1))
    energies = np.concatenate(energies)
    found = (energies / energies.mean()).var()
    expected = 1 / speckle_modes(one, CAMERA, Etalon(surface_rms=0), AIR)
    # relative variance of a variance: 2 / n, and 6 / (n M) more for a Gamma distribution
    assert abs(found / expected - 1) < 4 * math.sqrt((2 + 6 * expected) / pulses)


def test_modes_in_space():
    """A Omega / lambda^2 = 0.13 m2 x pi (0.039 / 56)^2 / (354.7 nm)^2 = 1.574e6, 2.10 a pixel."""
    one = speckle_modes(DopplerLidar(telescope_area=1e-9), CAMERA, ETALON, AIR)
    all_modes = speckle_modes(LIDAR, CAMERA, ETALON, AIR)
    assert all_modes / one == pytest.approx(1.574e6 / PIXELS, rel=2e-3)
    # coherence time 0.4 ns of 67 ns
    assert one == pytest.approx(66.7 / 0.397, rel=0.01)


def test_field_of_view_cuts_the_spot():
    narrow, wide = (DopplerLidar(fov_half=f) for f in ("0.5 mrad", "5 mrad"))
    found = [
        speckle_modes(lidar, FringeCamera(width=9, height=7), ETALON, AIR)
        for lidar in (narrow, wide)
    ]
    assert found[1] / found[0] == pytest.approx((0.039 / 0.028) ** 2, rel=5e-3)


def test_a_pulse_on_the_ccd():
    """The whole chain: photons of the lidar equation, speckled, within 4 sigma."""
    number = photons(LIDAR)
    modes = speckle_modes(LIDAR, CAMERA, ETALON, AIR)
    image = fringe_image(CAMERA, ETALON, AIR, 20.0, number)
    per_pixel = solar_background(LIDAR, ETALON) / PIXELS
    frame = expose(image, CCD(), 1, modes=modes, background=per_pixel)[0].double()
    dark = 0.01 * PIXELS
    sigma = math.sqrt(number + float((image**2).sum()) / modes + PIXELS * (25 + 1 / 12))
    assert abs(float(frame.sum()) - number - solar_background(LIDAR, ETALON) - dark) < 4 * sigma


# bad input


@pytest.mark.parametrize(
    "changes",
    [
        {"wavelength": 0},
        {"range": "-3 m"},
        {"instrument_constant": 1.5},
        {"counted": "all"},
        {"backscatter": "3 / m^2"},
        {"telescope_area": "0.13 m"},
        {"line_shape": "voigt"},
        {"aerosol_fraction": 1.1},
        {"divergence_full": 5e-4},
        {"laser_width": "43 MHz"},
    ],
)
def test_bad_descriptions(changes):
    with pytest.raises(ValidationError, match=next(iter(changes))):
        DopplerLidar(**changes)


def test_monochromatic_light_has_no_coherence_time():
    line = Line(LIDAR.wavelength, [0.5, 0.5], [0.0, 0.0], [0.0, 1e9])
    with pytest.raises(InputError, match="sigmas: 0 Hz"):
        coherence_time(ETALON, line)
