"""Synthesised turbulence against theory. Physics tier.

Detects: a spectrum that is not the standards', a field that changes with the chunk, frozen air that
moves, evolving air that loses its correlation too fast or too slowly, an aircraft whose response is
not the integral of spectrum times transfer function. `validation.air` has variances, spectra and
structure functions of fields, and their divergence; tests/validation runs it.
"""

import itertools

import numpy as np
import pytest
from scipy import integrate, special

from lidar_mi.atmosphere.air.turbulence import Turbulence, energy_spectrum, turbulence
from lidar_mi.errors import InputError
from tests.support.turbulence import line_spectra, plunge, plunge_variance

SIGMA, LENGTH = 1.5, 150.0
SEEDS = range(100, 160)
# a cut of the spectrum that the largest waves here do not feel
SHORTEST = 3.0
K_SIGMA = 4.0


def agree(samples, expected, k=K_SIGMA):
    """Whether the mean over seeds is the expected one, and known well enough to tell."""
    samples = np.asarray(samples)
    error = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    assert (np.abs(samples.mean(axis=0) - expected) < k * error).all(), (
        samples.mean(axis=0),
        expected,
        error,
    )
    assert (error < 0.1 * np.abs(expected)).all()


@pytest.mark.parametrize("spectrum", ["von_karman", "kolmogorov"])
def test_energy_is_three_halves_of_the_variance(spectrum):
    edges = [1e-7, 1.3059 / LENGTH, 1.307 / LENGTH, 1.0, 1e6]
    total = sum(
        integrate.quad(
            lambda s: np.exp(s) * energy_spectrum(np.exp(s), SIGMA, LENGTH, spectrum),
            np.log(low),
            np.log(high),
        )[0]
        for low, high in itertools.pairwise(edges)
    )
    assert total == pytest.approx(1.5 * SIGMA**2, rel=1e-3)


def test_line_spectra_are_those_of_the_standards():
    """MIL-F-8785C, 3.7.1.2, and CS 25.341(b)(2), from E(k) by Batchelor's relations."""

    def line(k1, across):
        def integrand(s):
            k = np.exp(s)
            weight = (1 + (k1 / k) ** 2) / 2 if across else 1 - (k1 / k) ** 2
            return float(energy_spectrum(k, SIGMA, LENGTH, "von_karman")) * weight

        return integrate.quad(integrand, np.log(k1), np.log(1e4), limit=200)[0]

    for k1 in (1e-4, 1e-3, 1e-2, 0.1, 1.0):
        longitudinal, transverse = line_spectra(k1, SIGMA, LENGTH)
        assert line(k1, across=False) == pytest.approx(longitudinal, rel=2e-3)
        assert line(k1, across=True) == pytest.approx(transverse, rel=2e-3)


def test_both_spectra_have_one_inertial_range():
    k = np.array([1.0, 10.0])
    ours = energy_spectrum(k, SIGMA, LENGTH, "kolmogorov")
    np.testing.assert_allclose(ours, energy_spectrum(k, SIGMA, LENGTH, "von_karman"), rtol=2e-4)


def test_kolmogorov_law():
    """D_LL = 27/55 Gamma(1/3) C eps^(2/3) r^(2/3) (Monin and Yaglom 1975, 13.46 and 21.24)."""
    length, shortest, r = 3000.0, 0.5, 20.0
    # E = C eps^(2/3) k^(-5/3): the constant and the missing waves
    c_eps = float(energy_spectrum(1.0, SIGMA, length, "kolmogorov"))
    missing = c_eps * (2 * np.pi / shortest) ** (-2 / 3)
    random = np.random.default_rng(3)
    here = random.uniform(-5000, 5000, (3, 400))
    found = []
    for seed in SEEDS:
        field = turbulence(SIGMA, length, seed, spectrum="kolmogorov", shortest=shortest)
        change = np.subtract(
            field.velocity(here[0] + r, *here[1:], 0.0), field.velocity(*here, 0.0)
        )
        found.append((change[0] ** 2).mean())
    expected = 27 / 55 * special.gamma(1 / 3) * c_eps * r ** (2 / 3) - 2 * missing
    agree(found, expected)


def test_single_precision_of_phases_does_not_show():
    field = turbulence(SIGMA, LENGTH, 6)
    random = np.random.default_rng(7)
    place = np.vstack([random.uniform(-300, 300, (3, 5000)) + 5000, random.uniform(0, 20, 5000)])
    phase = place.T @ field.waves
    exact = np.cos(phase) @ field.amplitudes[0] + np.sin(phase) @ field.amplitudes[1]
    assert np.abs(np.stack(field.velocity(*place)) - exact.T).max() < 2e-4 * SIGMA


def test_broadcasting_and_seeds():
    field = turbulence(SIGMA, LENGTH, 8)
    u, v, w = field.velocity(np.arange(3.0)[:, None], np.arange(2.0), 0.0, 0.0)
    assert u.shape == v.shape == w.shape == (3, 2)
    assert u[2, 1] == pytest.approx(float(field.velocity(2.0, 1.0, 0.0, 0.0)[0]), abs=1e-4)
    again, other = (turbulence(SIGMA, LENGTH, seed) for seed in (8, 9))
    assert (again.amplitudes == field.amplitudes).all()
    assert (other.amplitudes != field.amplitudes).any()


@pytest.mark.parametrize("evolution", ["frozen", "turnover", "sweeping"])
def test_correlation_in_time(evolution):
    """At a place: 1; and as the mean over modes of the characteristic function of their rates."""
    lag = 60.0
    random = np.random.default_rng(10)
    places = random.uniform(-5000, 5000, (3, 500))
    found = []
    for seed in SEEDS:
        field = turbulence(SIGMA, LENGTH, seed, shortest=SHORTEST, evolution=evolution)
        now, later = (np.stack(field.velocity(*places, t)) for t in (0.0, lag))
        found.append((now * later).mean())

    def weight(s):
        k = np.exp(s)
        energy = float(energy_spectrum(k, SIGMA, LENGTH, "von_karman"))
        square = {"frozen": 0.0, "turnover": 0.25 * k**3 * energy, "sweeping": (SIGMA * k) ** 2}
        return k * energy * np.exp(-square[evolution] * lag**2 / 2)

    limits = np.log([0.05 / LENGTH, 2 * np.pi / SHORTEST])
    expected = 2 / 3 * integrate.quad(weight, *limits, limit=200)[0]
    agree(found, expected)


# --- a known aircraft -----------------------------------------------------------------------


def test_plunge_of_a_small_aircraft():
    """A point mass with lift: its acceleration is the integral of the standard's spectrum |H|^2.

    m w' = -q S a (w - w_gust)/V: tau = m V/(q S a). A Cessna 172 of 1000 kg and 16.2 m^2 at 60 m/s,
    its span that of a point against the length.
    """
    mass, area, speed, slope, density = 1000.0, 16.2, 60.0, 4.9, 1.2
    tau = mass / (0.5 * density * speed * area * slope)
    time = 0.02 * np.arange(3000)
    found = []
    for seed in SEEDS:
        field = turbulence(SIGMA, LENGTH, seed, shortest=SHORTEST)
        gust = field.velocity(speed * time, 0.0, 0.0, time)[2]
        found.append((plunge(gust, 0.02, tau)[500:] ** 2).mean())
    agree(found, plunge_variance(SIGMA, LENGTH, SHORTEST, speed, tau))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sigma": -1.0}, r"turbulence\.sigma: -1\.0 is not allowed; expected 0 m/s or more"),
        ({"length": 0.0}, r"turbulence\.length: 0\.0 is not allowed"),
        ({"shortest": 40.0}, r"turbulence\.shortest: 40\.0 is not allowed; .* at most 15 m"),
        ({"spectrum": "dryden"}, r"turbulence\.spectrum: dryden .* von_karman or kolmogorov"),
        ({"evolution": "melting"}, r"turbulence\.evolution: melting"),
        ({"modes": 10}, r"turbulence\.modes: 10 is not allowed; expected 60 or more"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        turbulence(**{"sigma": SIGMA, "length": LENGTH, "seed": 1} | changes)


def test_no_turbulence():
    calm = turbulence(0.0, LENGTH, 1)
    assert isinstance(calm, Turbulence)
    assert not np.any(calm.velocity(1.0, 2.0, 3.0, 4.0))
