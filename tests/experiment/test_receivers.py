"""Receivers for the same light.

Detects: light counted twice or not lost, a required energy that does not give the error.
`validation.receivers` has published efficiencies and the bound; tests/validation runs it.
"""

import math

import numpy as np
import pytest
from scipy import constants

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.atmosphere.scattering.line import backscatter_line
from lidar_mi.errors import InputError
from lidar_mi.experiment import receivers
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.double_edge import DoubleEdge, harmonics
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.michelson import Michelson
from lidar_mi.retrieval.channels.assumption import assumption_error
from lidar_mi.retrieval.rings.model import PixelNoise
from validation.receivers import edges

# molecules without collisions, and next to nothing of the laser's width: one Gaussian
GAUSSIAN = DopplerLidar(line_shape="rayleigh", laser_width="45 MHz", pulse_duration="10 ns")
SIGMA = 2 / 354.7e-9 * math.sqrt(constants.k * 232.94 / (28.9644e-3 / constants.N_A))
QUIET = CCD(read_noise=0, dark_current=0, bits=None)
COARSE = FringeCamera(width=240, height=195, pixel=29.6e-6)


def photon_noise(receiver):
    """Without read noise and speckle."""
    return receiver._replace(noise=PixelNoise())


def ratio(receiver, v_los=0.0):
    """Standard error over that of the ideal analyser of a Gaussian line, photon noise alone."""
    ideal = 354.7e-9 / 2 * SIGMA / math.sqrt(receiver.level)
    return receivers.standard_error(photon_noise(receiver), v_los) / ideal


def fringes(**changes):
    values = {"contrast": 1.0, "elements": 64, **changes}
    return receivers.michelson_receiver(GAUSSIAN, Michelson(**values))


def test_one_output_costs_half_the_light():
    both, one = (ratio(fringes(outputs=n)) for n in (2, 1))
    assert one / both == pytest.approx(math.sqrt(2), rel=1e-6)
    assert receivers.detected_fraction(fringes(outputs=1)) == pytest.approx(0.5, abs=1e-3)


def test_filters_in_sequence_use_more_of_the_light():
    split, sequence = edges(1.7, 4.3), edges(1.7, 4.3, arrangement="sequential")
    assert 0.6 < ratio(sequence) / ratio(split) < 0.75


def test_ring_image_detects_the_mean_transmission():
    found = receivers.ring_receiver(DopplerLidar(), Etalon(), FringeCamera())
    # (1 - R) / (1 + R), but for orders that the camera cuts
    assert receivers.detected_fraction(found) == pytest.approx(0.3 / 1.7, rel=0.01)


def test_required_energy_has_the_error():
    for receiver in (
        receivers.michelson_receiver(DopplerLidar(), Michelson()),
        receivers.ring_receiver(DopplerLidar(range=150), Etalon(), COARSE),
    ):
        energy = receivers.required_energy(receiver, 0.5)
        assert receivers.standard_error(receiver, energy=energy) == pytest.approx(0.5, rel=1e-5)
    with pytest.raises(InputError, match="error: 0 m/s is not allowed"):
        receivers.required_energy(receiver, 0)


def test_wrong_temperature_moves_the_ratio_of_two_filters():
    """Retrieved with the response of air 5 K too warm; by inversion of that response."""
    lidar = DopplerLidar()
    receiver = receivers.double_edge_receiver(lidar, DoubleEdge(), QUIET)
    found = assumption_error(receiver.channels, 1e6, assumed="temperature", by=5.0, v_los=50.0)
    series = harmonics(DoubleEdge(), lidar.wavelength)
    times = np.arange(series.shape[1]) * DoubleEdge().delay(lidar.wavelength)
    pressure, usual, _ = standard_atmosphere(lidar.altitude)

    def response(v, kelvin):
        line = backscatter_line(lidar.wavelength, kelvin, pressure, lidar.laser_width)
        turned = series * line.shifted(2 * v / lidar.wavelength).characteristic(times)
        a, b = 2 * turned.sum(1).real - turned[:, 0].real
        return math.log(a / b)

    speeds = np.linspace(40, 60, 201)
    inverse = [response(v, usual + 5) for v in speeds]
    order = np.argsort(inverse)
    expected = np.interp(response(50.0, usual), np.array(inverse)[order], speeds[order]) - 50
    assert abs(expected) > 0.3
    assert found == pytest.approx(expected, abs=2e-3)
    for other in (
        receivers.michelson_receiver(lidar, Michelson()),
        receivers.ring_receiver(lidar, Etalon(), COARSE),
    ):
        error = assumption_error(other.channels, 1e6, assumed="temperature", by=5.0, v_los=50.0)
        assert abs(error) < abs(expected) / 5


def test_filters_without_a_slope():
    flat = DoubleEdge(spacing=DoubleEdge().etalon.free_spectral_range(354.7e-9))
    with pytest.raises(InputError, match="does not depend on the speed"):
        receivers.double_edge_receiver(DopplerLidar(), flat)


def test_speckle_adds_as_many_modes_as_there_are():
    """Photons per mode are the same for all receivers, but for what their filters pass."""
    fringe = receivers.michelson_receiver(DopplerLidar(), Michelson(elements=32))
    coarse = receivers.michelson_receiver(DopplerLidar(), Michelson(elements=16))
    assert coarse.noise.speckle_modes == pytest.approx(2 * fringe.noise.speckle_modes, rel=0.02)
