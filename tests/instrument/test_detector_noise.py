"""Counts of a detector against their distributions (chi-square) and moments (4 sigma of 100 000
draws: 0.5 % of a standard deviation, 2 % of a variance)."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.detector_noise import detect, noise_budget, noisy_scan
from lidar_mi.instrument.lidar import BackscatterLidar
from tests.support.detectors import IDEAL, ideal, s0_of

LIDAR = BackscatterLidar()

GATE = 5 / 299_792_458  # 2.5 m

DRAWS = 100_000


def read(photons, detector, seed=1, count=DRAWS, lidar=LIDAR):
    return detect(np.full(count, s0_of(photons)), lidar, detector, GATE, 500.0, seed)


def assert_moments(values, mean, variance, sigmas=4):
    n, deviation = len(values), values - mean
    assert abs(deviation.mean()) < sigmas * math.sqrt(variance / n)
    spread = math.sqrt((np.mean(deviation**4) - variance**2) / n)
    assert abs(np.mean(deviation**2) - variance) < sigmas * spread
    assert spread < 0.03 * variance


@pytest.mark.parametrize("photons", [3.0, 40.0])
def test_shot_noise_is_poisson(photons, chi_square_p):
    counts = read(photons, IDEAL).counts
    assert chi_square_p(counts, stats.poisson(photons)) > 1e-3


@pytest.mark.parametrize("photons", [3.0, 40.0])
@pytest.mark.parametrize("modes", [1.0, 2.5])
def test_speckled_counts_are_negative_binomial(photons, modes, chi_square_p):
    counts = read(photons, ideal(speckle=True, speckle_modes=modes)).counts
    assert chi_square_p(counts, stats.nbinom(modes, modes / (modes + photons))) > 1e-3


def test_exponential_gain():
    """Excess noise 2: every photoelectron's gain is exponential, cumulants n k! <g>^k."""
    n = 20.0
    counts = read(n, ideal(excess_noise_factor=2)).counts
    assert_moments(counts, n, 2 * n)
    cubes = (counts - n) ** 3
    assert abs(cubes.mean() - 6 * n) < 4 * cubes.std() / math.sqrt(DRAWS)
    # no photoelectron, no charge: e^-n of a weaker light
    dark = np.mean(read(2.0, ideal(excess_noise_factor=2)).counts == 0)
    assert dark == pytest.approx(math.exp(-2), abs=4 * math.sqrt(math.exp(-2) / DRAWS))


@pytest.mark.parametrize(
    "changes, mean, variance",
    [
        ({}, 1000, 1000),
        ({"excess_noise_factor": 1.25}, 1000, 1250),
        ({"quantum_efficiency": 0.4, "optics_efficiency": 0.5}, 200, 200),
        ({"dark_rate": 500 / GATE}, 1500, 1500),
        ({"readout_noise": 30.0}, 1000, 1900),
        ({"speckle": True, "speckle_modes": 50.0}, 1000, 21_000),
        # sky of 3e5 x 1 nm gives 826.6 photons, as calculated above
        ({"sky_radiance": 3e5, "excess_noise_factor": 1.5}, 1826.6, 2739.9),
        (
            {
                "sky_radiance": 3e5,
                "excess_noise_factor": 1.5,
                "speckle": True,
                "speckle_modes": 50.0,
                "dark_rate": 500 / GATE,
                "readout_noise": 30.0,
                "quantum_efficiency": 0.5,
            },
            500 + 413.3 + 500,
            1.5 * (500 + 413.3 + 500) + 500**2 / 50 + 900,
        ),
    ],
)
def test_mean_and_variance_of_every_noise(changes, mean, variance):
    """Also that the estimate is unbiased and its standard deviation is the stated one."""
    found = read(1000, ideal(**changes), seed=6)
    assert_moments(found.counts, mean, variance)
    assert found.s0_std == pytest.approx(found.s0_std[0], rel=1e-12)
    assert_moments((found.s0 - s0_of(1000)) / found.s0_std, 0, 1)


def test_pulses_of_a_beam_are_the_mean_of_as_many_readings():
    """The same distribution as that of four readings of their own, and half of the noise."""
    detector = ideal(
        sky_radiance=3e5,
        excess_noise_factor=1.5,
        speckle=True,
        speckle_modes=2.0,
        dark_rate=500 / GATE,
        readout_noise=30.0,
    )
    light = np.full(DRAWS, s0_of(300))
    together = detect(light, LIDAR, detector, GATE, 500.0, 11, pulses=4)
    each = [detect(light, LIDAR, detector, GATE, 500.0, [11, k + 1]) for k in range(4)]
    assert together.s0_std == pytest.approx(each[0].s0_std / 2, rel=1e-12)
    assert_moments((together.s0 - s0_of(300)) / together.s0_std, 0, 1)
    mean = np.mean([one.s0 for one in each], axis=0)
    assert stats.ks_2samp(together.s0, mean).pvalue > 1e-3
    found, one = (
        noise_budget(a_scan(), LIDAR, Detector(readout_noise=9.0), pulses) for pulses in (4, 1)
    )
    assert found["noise.all"] == pytest.approx(one["noise.all"] / 2)
    assert found["signal"] == pytest.approx(4 * one["signal"])
    scans = [noisy_scan(a_scan(), LIDAR, Detector(), 7, pulses=pulses) for pulses in (4, 1)]
    ratio = scans[0]["Y_noise_std"] / scans[1]["Y_noise_std"]
    assert ratio.values == pytest.approx(0.5, rel=1e-6)


def test_dark_pixel_by_day_is_unbiased_and_may_be_negative():
    found = read(0, Detector())
    assert found.s0.min() < 0
    assert_moments(found.s0 / found.s0_std, 0, 1)


def test_seeds():
    image = np.full((3, 4), s0_of(1e4))
    first, again, other, part = (
        detect(image, LIDAR, Detector(), GATE, 500.0, seed).s0 for seed in (1, 1, 2, [1, 0, 7])
    )
    np.testing.assert_array_equal(first, again)
    assert not np.any(first == other) and not np.any(first == part)
    assert len(np.unique(first)) == first.size


def a_scan(gates=2, polarized=1, count=60):
    """A homogeneous scan of 1e4 photons a gate at 500 m, depolarised by 0.25."""
    shape = (gates, count, count + 10)
    values = np.full(shape, s0_of(1e4), np.float32)
    stokes = {"S0": 1.0, "S1": 0.6 * polarized, "S2": 0.0, "S3": 0.0, "S0_stderr": 0.01}
    return xr.Dataset(
        {name: (("gate", "z", "y"), factor * values) for name, factor in stokes.items()},
        coords={
            "gate": np.arange(gates),
            "z": np.linspace(-35, 35, count),
            "y": np.linspace(-55, 55, count + 10),
        },
        attrs={
            "gate_start": 500.0,
            "gate_stop": 500 + 2.5 * gates,
            "gate_kind": "planar",
            "gate_count": gates,
            "environment_extinction": 1e-4,
            "polarized": polarized,
            "samples_per_beam": 64,
        },
    )


def test_noisy_scan_beside_the_clean_one():
    scan = a_scan()
    found = noisy_scan(scan, LIDAR, Detector(), 7)
    xr.testing.assert_equal(found[list(scan.data_vars)], scan)
    assert found["S0_noisy"].dims == found["S0_noise_std"].dims == ("gate", "z", "y")
    assert found["Y_noisy"].dims == found["Y_noise_std"].dims == ("z", "y")
    score = (found["S0_noisy"] - scan["S0"]) / found["S0_noise_std"]
    assert_moments(score.values.ravel(), 0, 1)
    # two gates, and neighbours, share no noise
    gates = np.corrcoef(score[0].values.ravel(), score[1].values.ravel())[0, 1]
    beams = np.corrcoef(score[0, :, 1:].values.ravel(), score[0, :, :-1].values.ravel())[0, 1]
    assert abs(gates) < 4 / math.sqrt(score[0].size) and abs(beams) < 4 / math.sqrt(score[0].size)
    assert found.attrs["detector_quantum_efficiency"] == 0.4
    assert found.attrs["gate_start"] == 500


def test_noise_follows_obliquity():
    """Slant beams spend longer in a planar gate: more sky, in a spherical gate the same."""
    scan = a_scan()
    slant = math.sqrt(1 + (55 / 502.5) ** 2 + (35 / 502.5) ** 2)
    sky = 0.2 * 826_600
    found = noisy_scan(scan, LIDAR, Detector(speckle=False, dark_rate=0), 7)
    corner = float(found["S0_noise_std"][0, 0, 0]) / s0_of(1 / 0.2)
    assert corner == pytest.approx(math.sqrt(1.25 * (2000 + sky * slant)), rel=1e-3)
    scan.attrs["gate_kind"] = "spherical"
    found = noisy_scan(scan, LIDAR, Detector(speckle=False, dark_rate=0), 7)
    corner = float(found["S0_noise_std"][0, 0, 0]) / s0_of(1 / 0.2)
    assert corner == pytest.approx(math.sqrt(1.25 * (2000 + sky)), rel=1e-4)


def test_attenuated_backscatter_of_the_noisy_image():
    """The lidar equation by hand at one pixel: r = 501.25 m x slant, 2.5 m x slant."""
    found = noisy_scan(a_scan(), LIDAR, Detector(), 7)
    y, z = float(found["y"][12]), float(found["z"][40])
    # beams are aimed at the middle of both gates
    slant = math.sqrt(1 + (y / 502.5) ** 2 + (z / 502.5) ** 2)
    r = 501.25 * slant
    factor = r**2 / (LIDAR.aperture_area * 2.5 * slant * math.exp(-2e-4 * r))
    for image, flat in (("S0_noisy", "Y_noisy"), ("S0_noise_std", "Y_noise_std")):
        expected = float(found[image][0, 40, 12]) * factor
        assert float(found[flat][40, 12]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("polarized, expected", [(1, 0.6), (0, 1.0)])
def test_speckle_follows_the_polarization_of_each_pixel(polarized, expected):
    """Where the rendering knew no polarisation, speckle is that of fully polarised light."""
    detector = Detector(line_width="1 kHz")
    lidar = BackscatterLidar(aperture_radius=1e-6)
    scan = a_scan(polarized=polarized)
    budget = noise_budget(scan, lidar, detector)
    assert budget["speckle_modes"] == pytest.approx(2 / (1 + expected**2), rel=0.01)


def test_noise_budget_of_a_homogeneous_scan():
    found = noise_budget(a_scan(), LIDAR, Detector())
    assert found["photons"] == pytest.approx(1e4, rel=1e-4)
    assert found["signal"] == pytest.approx(2000, rel=1e-4)
    assert found["background"] == pytest.approx(0.2 * 826_600, rel=0.01)
    assert found["dark"] == pytest.approx(1.668e-5, rel=0.01)
    assert found["noise.shot"] == pytest.approx(math.sqrt(1.25 / 2000), rel=1e-4)
    parts = [found[f"noise.{x}"] for x in ("shot", "speckle", "background", "dark", "readout")]
    assert found["noise.all"] == pytest.approx(math.hypot(*parts), rel=1e-3)
    assert "speckle_modes" not in noise_budget(a_scan(), LIDAR, Detector(speckle=False))


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"s0": [1e-9, -1e-9]}, "S0: -1e-09 is not allowed; expected finite values, 0 or more"),
        ({"s0": [1e-9, math.nan]}, "S0: nan is"),
        ({"s0": math.inf}, "S0: inf is"),
        ({"duration": 0.0}, "duration: 0 is"),
        ({"distance": [500.0, -1.0]}, "distance: -1 is"),
        ({"polarization": 1.1}, "polarization: 1.1 is not allowed; expected 0 to 1"),
        ({"seed": -1}, "seed: -1 is"),
        ({"seed": "one"}, "seed: 'one' is"),
        (
            {"s0": 1.0, "lidar": BackscatterLidar(pulse_energy="1e4 J")},
            "lidar.pulse_energy: 10000 J",
        ),
    ],
)
def test_bad_light_is_refused(changes, message):
    good = {"s0": 1e-9, "lidar": LIDAR, "duration": GATE, "distance": 500.0, "seed": 1}
    with pytest.raises(InputError) as error:
        detect(**good | changes, detector=IDEAL)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["gate_start", "gate_kind", "environment_extinction"])
def test_scan_without_its_gates(name):
    scan = a_scan()
    del scan.attrs[name]
    with pytest.raises(InputError, match=f"attribute {name} is missing"):
        noisy_scan(scan, LIDAR, Detector(), 1)


def test_budget_of_a_dark_scan_is_refused():
    scan = a_scan()
    scan["S0"] *= 0
    with pytest.raises(InputError, match="S0: 0 everywhere"):
        noise_budget(scan, LIDAR, Detector())
