"""Synthesised turbulence against theory. Physics tier.

Detects: a spectrum that is not the standards', too much or too little variance, structure functions
that differ between along and across, divergence, a field that changes with the chunk, frozen air
that moves, evolving air that loses its correlation too fast or too slowly, an aircraft whose
response is not the integral of spectrum times transfer function.
"""

import itertools

import numpy as np
import pytest
from scipy import integrate, special

from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import Commands, loads_in_wind
from lidar_mi.aircraft.strips import Loads
from lidar_mi.atmosphere.air.turbulence import Turbulence, energy_spectrum, turbulence
from lidar_mi.errors import InputError
from lidar_mi.schema.encounter import Aircraft, Path
from tests.support.turbulence import (
    correlations,
    finer_variance,
    line_spectra,
    plunge,
    plunge_variance,
    roll_rate_variance,
)

SIGMA, LENGTH = 1.5, 150.0
SEEDS = range(100, 160)
# a cut of the spectrum that the largest waves here do not feel
SHORTEST = 3.0
K_SIGMA = 4.0


def finer():
    """Variance of a component in waves that the fields here do not have."""
    return finer_variance(SIGMA, LENGTH, SHORTEST)


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


@pytest.fixture(scope="module")
def fields():
    return [turbulence(SIGMA, LENGTH, seed, shortest=SHORTEST) for seed in SEEDS]


def test_variance_of_all_components(fields):
    random = np.random.default_rng(1)
    places = random.uniform(-5000, 5000, (3, 1500))
    found = [np.square(field.velocity(*places, 0.0)).mean(axis=1) for field in fields]
    agree(found, SIGMA**2 - finer())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_structure_functions(fields, axis):
    """Along the separation 2 sigma^2 (1 - f), across 2 sigma^2 (1 - g), in every direction."""
    random = np.random.default_rng(2)
    here = random.uniform(-5000, 5000, (3, 400))
    for r in (8.0, 30.0, 100.0):
        there = here + r * np.eye(3)[axis][:, None]
        found = []
        for field in fields:
            change = np.subtract(field.velocity(*there, 0.0), field.velocity(*here, 0.0))
            square = (change**2).mean(axis=1)
            found.append([square[axis], (square.sum() - square[axis]) / 2])
        expected = 2 * SIGMA**2 * (1 - np.array(correlations(r, LENGTH))) - 2 * finer()
        agree(found, expected)


def test_line_spectrum_of_a_flight(fields):
    """Of w and u along x in octaves; the window leaks little from one octave to the next."""
    step, count = 1.5, 4096
    x = step * np.arange(count)
    window = np.hanning(count)
    k1 = 2 * np.pi * np.fft.rfftfreq(count, step)
    found = []
    for field in fields:
        rows = []
        for component in field.velocity(x, 0.0, 0.0, 0.0)[::2]:
            power = np.abs(np.fft.rfft(window * component)) ** 2
            density = power * 2 * step / (2 * np.pi * (window**2).sum())
            rows.append([density[octave].mean() for octave in octaves(k1)])
        found.append(rows)
    laws = line_spectra(k1, SIGMA, LENGTH, SHORTEST)
    expected = [[law[octave].mean() for octave in octaves(k1)] for law in laws]
    agree(found, np.array(expected))


def octaves(k1):
    return [(k1 >= low) & (k1 < 2 * low) for low in (0.01, 0.02, 0.05, 0.1, 0.2)]


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


def test_no_divergence():
    field = turbulence(SIGMA, LENGTH, 4, shortest=15.0)
    k, (a, b) = field.waves[:3], field.amplitudes
    for amplitude in (a, b):
        assert np.abs((k.T * amplitude).sum(1)).max() < 1e-12 * np.abs(k).max()
    # and as a function of place: central differences, of which 2e-4 remain
    random = np.random.default_rng(5)
    place, h = random.uniform(-500, 500, (3, 300)), 0.2
    gradient = np.empty((3, 3, 300))
    for axis in range(3):
        shift = h * np.eye(3)[axis][:, None]
        gradient[axis] = np.subtract(
            field.velocity(*(place + shift), 0.0), field.velocity(*(place - shift), 0.0)
        ) / (2 * h)
    divergence = gradient[0, 0] + gradient[1, 1] + gradient[2, 2]
    assert np.sqrt((divergence**2).mean()) < 2e-3 * np.sqrt((gradient**2).sum((0, 1)).mean())


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


@pytest.mark.slow
def test_roll_of_the_default_aircraft():
    """Roll rate of a Boeing 737 by strips: from the transverse correlation between all strips."""
    path = Path(climb_angle=0.0)
    step, count = 0.025, 1600
    time = step * np.arange(count)
    found = []
    for seed in SEEDS:
        model = RollModel(Aircraft(), path)
        field = turbulence(SIGMA, LENGTH, seed, shortest=SHORTEST)
        loads = loads_in_wind(model.strips, model.state, field.velocity, model.density, time)
        rates = []
        for force, moment in zip(loads.force, loads.moment, strict=True):
            rates.append(model.state.roll_rate)
            model.step(step, Loads(force, moment), Commands())
        assert not model.state.departed
        found.append((np.square(rates)[80:]).mean())
    agree(found, roll_rate_variance(SIGMA, LENGTH, RollModel(Aircraft(), path)))


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
