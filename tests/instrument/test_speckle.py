"""Modes of speckle: physics tests against the definition of M by drawing pairs of points (1 %)."""

import math

import numpy as np
import pytest
from scipy import integrate, special

from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.speckle import (
    footprint_radius,
    spatial_modes,
    speckle_modes,
    temporal_modes,
)

LIDAR = BackscatterLidar()

GATE = 5 / 299_792_458  # 2.5 m


@pytest.mark.parametrize("product", [0.05, 0.5, 2.0, 10.0])
def test_temporal_modes_by_their_definition(product):
    """1/M = mean |g(t - t')|^2 over pairs of times, and g the mean of exp(2 pi i nu t) over the
    line: one cosine for each draw of two times and two frequencies."""
    random = np.random.default_rng(3)
    n, duration = 1_000_000, 16.7e-9
    line = product / duration
    times = np.diff(random.uniform(0, duration, (2, n)), axis=0)
    frequencies = np.diff(random.normal(0, line / 2.354820, (2, n)), axis=0)
    draws = np.cos(2 * np.pi * frequencies * times)
    assert abs(draws.mean() - 1 / temporal_modes(line, duration)) < 4 * draws.std() / math.sqrt(n)


@pytest.mark.parametrize("radius", [0.02, 0.06, 0.2])
def test_spatial_modes_by_their_definition(radius):
    """The same for two points of the telescope and two of a Gaussian footprint."""
    random = np.random.default_rng(4)
    n, distance, footprint, wavelength = 1_000_000, 500.0, 1e-3, 532e-9
    angle = random.uniform(0, 2 * np.pi, (2, n))
    where = radius * np.sqrt(random.uniform(0, 1, (2, n)))
    across = np.diff(where * np.cos(angle), axis=0)[0], np.diff(where * np.sin(angle), axis=0)[0]
    # 1/e^2 radius w: standard deviation w / 2 an axis
    spot = np.diff(random.normal(0, footprint / 2, (2, 2, n)), axis=0)[0]
    phase = 2 * np.pi / (wavelength * distance) * (across[0] * spot[0] + across[1] * spot[1])
    found = spatial_modes(radius, wavelength, footprint, distance)
    assert abs(np.cos(phase).mean() - 1 / found) < 4 * np.cos(phase).std() / math.sqrt(n)


def effective_area(lidar, distance):
    """(int I)^2 / int I^2 of a cut Gaussian beam spread by its divergence: 1 / int f^2, where the
    aperture is transformed by quadrature and the divergence multiplies its transform."""
    cut, w = lidar.beam_cut, lidar.beam_radius
    sigma = lidar.divergence_full / 2 * distance / 2
    nodes, weights = np.polynomial.legendre.leggauss(200)
    r, dr = cut * (nodes + 1) / 2, cut * weights / 2
    profile = np.exp(-2 * r**2 / w**2) * r * dr
    # a sharp edge's transform falls as k^-3/2, so |.|^2 k leaves 1 / (pi K cut): 0.05 % at K
    k = np.linspace(0, min(10 / max(sigma, 1e-9), 600 / cut), 20_001)
    transform = (special.j0(k[:, None] * r) @ profile) / profile.sum()
    transform *= np.exp(-((k * sigma) ** 2) / 2)
    return 2 * np.pi / integrate.simpson(transform**2 * k, x=k)


@pytest.mark.parametrize(
    "lidar, distance, tolerance",
    [
        (BackscatterLidar(beam_cut=math.inf), 500.0, 1e-9),
        (LIDAR, 500.0, 1e-4),
        (LIDAR, 100.0, 0.02),
        (BackscatterLidar(beam_radius=2.0, beam_cut=0.1, divergence_full=0), 500.0, 3e-3),
    ],
)
def test_footprint_has_the_beams_effective_area(lidar, distance, tolerance):
    lidar = lidar.model_copy(update={"fov_half": 0.4})
    if lidar.beam_cut == math.inf:
        expected = math.pi * (0.1**2 + 0.5**2)
    else:
        expected = effective_area(lidar, distance)
    found = math.pi * footprint_radius(lidar, distance) ** 2
    assert found == pytest.approx(expected, rel=tolerance)


def test_footprint_of_a_collimated_cut_beam_is_a_tenth_too_small():
    """Exactly: pi w^2 tanh(cut^2 / w^2), a Gaussian inside a sharp edge."""
    lidar = BackscatterLidar(divergence_full=0)
    exact = 0.1 * math.sqrt(math.tanh(1))
    assert 0.89 < (footprint_radius(lidar, 500.0) / exact) ** 2 < 0.91


def test_modes_of_the_papers_lidar():
    """A Omega / lambda^2 = 0.7854 x pi (0.50125^2 + 0.0069) / 501.25^2 / 532e-9^2 = 8.96e6, times
    753.5 coherence times in the gate: 6.75e9 modes of one polarisation."""
    found = speckle_modes(Detector(), LIDAR, GATE, 501.25)
    assert found == pytest.approx(8.96e6 * 753.5, rel=2e-3)


@pytest.mark.parametrize("polarization", [0.0, 0.6, 1.0])
def test_partial_polarization_adds_modes(polarization):
    """Two independent exponential intensities, (1 +- P) / 2 of the light each."""
    random = np.random.default_rng(5)
    n = 1_000_000
    light = sum(random.exponential((1 + s * polarization) / 2, n) for s in (-1, 1))
    deviation = (light - 1) ** 2
    ratio = speckle_modes(Detector(), LIDAR, GATE, 500.0, polarization) / speckle_modes(
        Detector(), LIDAR, GATE, 500.0
    )
    assert abs(deviation.mean() - 1 / ratio) < 4 * deviation.std() / math.sqrt(n)


def test_speckle_given_and_off():
    assert speckle_modes(Detector(speckle_modes=7), LIDAR, GATE, 500.0) == 7
    assert speckle_modes(Detector(speckle=False), LIDAR, GATE, 500.0) == math.inf


def test_line_narrower_than_the_pulse_allows_is_refused():
    """Time-bandwidth product of a Gaussian pulse: 2 ln 2 / pi = 0.441."""
    lidar = BackscatterLidar(pulse_duration="10 ns")
    speckle_modes(Detector(line_width="44.2 MHz"), lidar, GATE, 500.0)
    with pytest.raises(InputError, match=r"detector\.line_width: 4e\+07 Hz .* 4\.4e\+07 Hz$"):
        speckle_modes(Detector(line_width="40 MHz"), lidar, GATE, 500.0)
