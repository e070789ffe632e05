"""Photon numbers, modes of speckle and noise of the detector.

Photon numbers are compared with published ones (2 digits) and hand calculations (0.1 %), modes with
the definition of M by drawing pairs of points (1 %), counts with their distributions (chi-square)
and moments (4 sigma of 100 000 draws: 0.5 % of a standard deviation, 2 % of a variance).
"""

import math

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError
from scipy import integrate, special, stats

from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import (
    Detector,
    background_photoelectrons,
    dark_counts,
    detect,
    footprint_radius,
    gate_duration,
    noise_budget,
    noise_terms,
    noise_variance,
    noisy_scan,
    photons_per_energy,
    signal_photoelectrons,
    spatial_modes,
    speckle_modes,
    temporal_modes,
)
from lidar_mi.instrument.lidar import BackscatterLidar

LIDAR = BackscatterLidar()
# nothing but the Poisson noise of the signal, every photon counted
IDEAL = Detector(
    optics_efficiency=1,
    quantum_efficiency=1,
    excess_noise_factor=1,
    dark_rate=0,
    sky_radiance=0,
    speckle=False,
)
GATE = 5 / 299_792_458  # 2.5 m
DRAWS = 100_000


def ideal(**changes):
    return IDEAL.model_copy(update=changes)


def s0_of(photons):
    """Received over emitted energy of that many photons with the paper's lidar (1 mJ, 532 nm)."""
    return photons * 3.73393e-19 / 1e-3


def read(photons, detector, seed=1, count=DRAWS, lidar=LIDAR):
    return detect(np.full(count, s0_of(photons)), lidar, detector, GATE, 500.0, seed)


def assert_moments(values, mean, variance, sigmas=4):
    n, deviation = len(values), values - mean
    assert abs(deviation.mean()) < sigmas * math.sqrt(variance / n)
    spread = math.sqrt((np.mean(deviation**4) - variance**2) / n)
    assert abs(np.mean(deviation**2) - variance) < sigmas * spread
    assert spread < 0.03 * variance


# photon numbers


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


# speckle


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


def test_limits_of_temporal_modes():
    assert temporal_modes(1.0, 1e-9) == pytest.approx(1, rel=1e-12)
    # T over coherence time, 0.664 / line width; the first correction is 1 / (pi x)
    assert temporal_modes(30e9, 16.678e-9) == pytest.approx(16.678 * 30 / 0.66428 + 0.318, rel=1e-5)
    assert np.all(np.diff(temporal_modes(np.geomspace(1e3, 1e12, 200), 1e-8)) >= -1e-12)


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


def test_limits_of_spatial_modes():
    assert spatial_modes(1e-6, 532e-9, 1e-3, 500.0) == pytest.approx(1, abs=1e-9)
    etendue = math.pi * 0.5**2 * math.pi * 0.5**2 / 500**2 / 532e-9**2
    # the first correction is sqrt(2 / (pi a)) = 2e-4 for these 9 million modes
    assert spatial_modes(0.5, 532e-9, 0.5, 500.0) == pytest.approx(etendue, rel=4e-4)
    # 1 / M = <|mu|^2> = 1 - (pi w / (lambda r))^2 <d^2> for close points, <d^2> = R^2 in a disc
    a = np.array([0.1, 0.99, 1.01, 10]) * 1e-6
    radii = 532e-9 * 500 / (math.pi * 1e-3) * np.sqrt(a / 2)
    assert spatial_modes(radii, 532e-9, 1e-3, 500.0) == pytest.approx(1 + a / 2, abs=1e-9)


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


@pytest.mark.parametrize("fov", ["0.2 mrad", "1 mrad", "5 mrad"])
def test_field_of_view_cuts_the_footprint(fov):
    lidar = BackscatterLidar(beam_radius=1e-4, beam_cut=math.inf, fov_half=fov)
    edge, w = 500 * lidar.fov_half, 0.5
    light, squares = (
        integrate.quad(lambda r, n=n: 2 * np.pi * r * np.exp(-2 * n * r**2 / w**2), 0, edge)[0]
        for n in (1, 2)
    )
    found = math.pi * footprint_radius(lidar, 500.0) ** 2
    assert found == pytest.approx(light**2 / squares, rel=1e-6)


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


# counts


@pytest.mark.parametrize("photons", [3.0, 40.0])
def test_shot_noise_is_poisson(photons, chi_square_p):
    counts = read(photons, IDEAL).counts
    assert chi_square_p(counts, stats.poisson(photons)) > 1e-3


@pytest.mark.parametrize("photons", [3.0, 40.0])
@pytest.mark.parametrize("modes", [1.0, 2.5])
def test_speckled_counts_are_negative_binomial(photons, modes, chi_square_p):
    counts = read(photons, ideal(speckle=True, speckle_modes=modes)).counts
    assert chi_square_p(counts, stats.nbinom(modes, modes / (modes + photons))) > 1e-3


def test_one_mode_of_strong_light_is_exponential():
    counts = read(1e6, ideal(speckle=True, speckle_modes=1)).counts
    assert stats.kstest(counts, stats.expon(scale=1e6).cdf).pvalue > 1e-3


def test_many_modes_are_poisson(chi_square_p):
    """Variance n (1 + n / M): 4e-8 more than without speckle."""
    counts = read(40.0, ideal(speckle=True, speckle_modes=1e9)).counts
    assert chi_square_p(counts, stats.poisson(40)) > 1e-3


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


def test_no_light_at_all():
    found = read(0, ideal(speckle=True), count=5)
    assert not found.counts.any() and not found.s0.any() and not found.s0_std.any()


def test_dark_pixel_by_day_is_unbiased_and_may_be_negative():
    found = read(0, Detector())
    assert found.s0.min() < 0
    assert_moments(found.s0 / found.s0_std, 0, 1)


def test_terms_add_up():
    detector = Detector(excess_noise_factor=2, readout_noise=3)
    terms = noise_terms(100.0, 10.0, 1.0, 20.0, detector)
    expected = {"shot": 200, "speckle": 500, "background": 20, "dark": 2, "readout": 9}
    assert terms == pytest.approx(expected)
    assert noise_variance(100.0, 10.0, 1.0, 20.0, detector) == pytest.approx(731)


def test_seeds():
    image = np.full((3, 4), s0_of(1e4))
    first, again, other, part = (
        detect(image, LIDAR, Detector(), GATE, 500.0, seed).s0 for seed in (1, 1, 2, [1, 0, 7])
    )
    np.testing.assert_array_equal(first, again)
    assert not np.any(first == other) and not np.any(first == part)
    assert len(np.unique(first)) == first.size


# a whole scan


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


def test_apparent_backscatter_of_the_noisy_image():
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


# descriptions and bad input


def test_units_of_the_description():
    detector = Detector(
        dark_rate="2 MHz",
        sky_radiance="100 mW/m^2/sr/nm",
        filter_bandwidth="0.3 nm",
        line_width="90 MHz",
    )
    assert detector.dark_rate == pytest.approx(2e6)
    assert detector.sky_radiance == pytest.approx(1e8)
    assert detector.filter_bandwidth == pytest.approx(3e-10)
    assert detector.line_width == pytest.approx(9e7)
    assert Detector.model_validate(detector.model_dump(mode="json")) == detector


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
        ({"s0": 1.0, "lidar": BackscatterLidar(pulse_energy=1e4)}, "lidar.pulse_energy: 10000 J"),
    ],
)
def test_bad_light_is_refused(changes, message):
    good = {"s0": 1e-9, "lidar": LIDAR, "duration": GATE, "distance": 500.0, "seed": 1}
    with pytest.raises(InputError) as error:
        detect(**good | changes, detector=IDEAL)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["gate_start", "gate_kind", "environment_extinction"])
def test_scan_that_does_not_say_its_gates(name):
    scan = a_scan()
    del scan.attrs[name]
    with pytest.raises(InputError, match=f"attribute {name} is missing"):
        noisy_scan(scan, LIDAR, Detector(), 1)


def test_budget_of_a_dark_scan_is_refused():
    scan = a_scan()
    scan["S0"] *= 0
    with pytest.raises(InputError, match="S0: 0 everywhere"):
        noise_budget(scan, LIDAR, Detector())
