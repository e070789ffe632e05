"""Photon numbers and the description of a detector: physics tests. Detect 0.1 % of a hand
calculation, 2 digits of a published number, and any bad description accepted."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from lidar_mi.instrument.detector import (
    Detector,
    background_photoelectrons,
    dark_counts,
    gate_duration,
    photons_per_energy,
    signal_photoelectrons,
)
from lidar_mi.instrument.lidar import BackscatterLidar
from tests.support.detectors import ideal, s0_of

LIDAR = BackscatterLidar()


def test_energy_of_a_photon():
    """h c / lambda = 6.62607e-34 x 2.99792e8 / 532e-9 = 3.73393e-19 J."""
    assert 1 / photons_per_energy(532e-9) == pytest.approx(3.73393e-19, rel=1e-5)


@pytest.mark.parametrize("distance, published", [(76, 1.3e7), (56, 2.4e7)])
def test_published_photon_numbers_of_the_doppler_lidar(distance, published):
    """70 mJ at 354.7 nm, beta 3.104e-6 /m/sr, 0.13 m2, constant 0.15, bin 10 m: two digits."""
    s0 = 3.104e-6 * 10 * 0.13 / distance**2 * math.exp(-2 * 2.7e-5 * distance)
    found = signal_photoelectrons(s0, 0.07, 354.7e-9, ideal(optics_efficiency=0.15))
    assert float(f"{found:.1e}") == published


def test_signal_grows_with_energy_wavelength_and_efficiencies():
    detector = ideal(optics_efficiency=0.5, quantum_efficiency=0.4)
    one = signal_photoelectrons(s0_of(1000), 1e-3, 532e-9, detector)
    assert one == pytest.approx(200, rel=1e-5)
    assert signal_photoelectrons(s0_of(1000), 0.1, 1064e-9, detector) == pytest.approx(200 * one)


def test_solar_background_of_the_papers_gate():
    """0.3 W/m2/sr/nm x 1 nm x 0.7854 m2 x 7.854e-5 sr = 1.8506e-5 W; in 16.678 ns 3.0864e-13 J,
    826 600 photons."""
    duration = gate_duration(2.5)
    assert duration == pytest.approx(16.678e-9, rel=1e-4)
    found = background_photoelectrons(
        ideal(sky_radiance=3e8, filter_bandwidth=1e-9), duration, LIDAR.aperture_area, 5e-3, 532e-9
    )
    assert found == pytest.approx(826_600, rel=1e-4)
    assert background_photoelectrons(Detector(), duration, math.pi / 4, 5e-3, 532e-9) == (
        pytest.approx(0.2 * found)
    )


def test_solid_angle_of_a_wide_field_is_that_of_a_cone():
    """2 pi (1 - cos 60 deg) = pi, against a field of 1 mrad half."""
    wide, narrow = (
        background_photoelectrons(Detector(), 1e-8, 1.0, fov, 532e-9) for fov in (math.pi / 3, 1e-3)
    )
    assert wide / narrow == pytest.approx(1e6, rel=1e-6)


def test_dark_counts():
    assert dark_counts(Detector(dark_rate="2 MHz"), np.array([1e-6, 1e-8])) == pytest.approx(
        [2, 0.02]
    )


@pytest.mark.parametrize(
    "bad",
    [
        {"optics_efficiency": 0},
        {"optics_efficiency": 1.1},
        {"quantum_efficiency": 0},
        {"quantum_efficiency": 1.01},
        {"excess_noise_factor": 0.9},
        {"dark_rate": -1},
        {"dark_rate": "1 kg"},
        {"readout_noise": -1},
        {"sky_radiance": "0.3 W/m^2/sr"},
        {"sky_radiance": -1},
        {"filter_bandwidth": 0},
        {"line_width": 0},
        {"line_width": math.inf},
        {"speckle_modes": 0.5},
        {"speckle": False, "speckle_modes": 5},
        {"quantum_eficiency": 0.4},
    ],
)
def test_bad_descriptions_are_refused(bad):
    with pytest.raises(ValidationError):
        Detector(**bad)
