"""The laser's photons against closed-form distributions, its Stokes vector and its errors.

Detects: a radius, divergence or truncation wrong by 0.5 % (Kolmogorov-Smirnov, 400 000 photons:
critical deviation of the distribution 0.003 at the 0.1 % level).
"""

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import kstest, pearsonr, uniform

pytestmark = pytest.mark.usefixtures("variant")

NUMBER = 400_000


def laser(**parameters):
    return mi.load_dict({"type": "laser", **parameters})


def photons(plugin, seed=1):
    rng = np.random.default_rng(seed)
    pairs = [
        mi.Point2f(mi.Float(rng.random(NUMBER)), mi.Float(rng.random(NUMBER))) for _ in range(2)
    ]
    origin, direction = plugin.sample_local(*pairs)
    return np.array(origin).astype(float), np.array(direction).astype(float)


@pytest.mark.parametrize(
    ("radius", "cut"), [(0.1, 0.1), (0.1, 0.03), (0.02, 0.1), (0.1, math.inf), (0.1, None)]
)
def test_fluence_over_the_aperture_is_a_truncated_gaussian(radius, cut):
    """P(r) = (1 - exp(-2 r^2 / w^2)) / (1 - exp(-2 cut^2 / w^2)) up to the cut."""
    given = {} if cut is None else {"beam_cut": cut}
    limit = cut or math.inf
    (x, y, z), _ = photons(laser(beam_radius=radius, **given))
    r = np.hypot(x, y)
    assert (z == 0).all() and r.max() <= limit * (1 + 1e-6)
    inside = -math.expm1(-2 * (limit / radius) ** 2)
    assert kstest(r, lambda r: -np.expm1(-2 * (r / radius) ** 2) / inside).pvalue > 1e-3
    # three quantiles, each within 4 sigma of its order statistic
    for q in (0.1, 0.5, 0.9):
        expected = radius * math.sqrt(-0.5 * math.log1p(-q * inside))
        density = 4 * expected / radius**2 * (1 - q * inside) / inside
        sigma = math.sqrt(q * (1 - q) / NUMBER) / density
        assert abs(np.quantile(r, q) - expected) < 4 * sigma
    assert kstest(np.arctan2(y, x), uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    "full_mrad", [2.0, *(pytest.param(full, marks=pytest.mark.slow) for full in (0.1, 200.0))]
)
def test_divergence_is_1_over_e2_at_half_the_full_angle(full_mrad):
    _, (x, y, z) = photons(laser(divergence_full_mrad=full_mrad))
    tangent = np.hypot(x, y) / z
    half = full_mrad * 1e-3 / 2
    assert kstest(tangent, lambda t: -np.expm1(-2 * (t / half) ** 2)).pvalue > 1e-3
    fraction = np.mean(tangent < half)
    expected = 1 - math.exp(-2)
    assert abs(fraction - expected) < 4 * math.sqrt(expected * (1 - expected) / NUMBER)
    assert kstest(np.arctan2(y, x), uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
    assert np.linalg.norm([x, y, z], axis=0) == pytest.approx(1, abs=1e-6)


def test_position_and_direction_are_independent():
    origin, direction = photons(laser(divergence_full_mrad=2.0))
    for a in (*origin[:2], np.hypot(*origin[:2])):
        for b in (*direction[:2], np.hypot(*direction[:2])):
            assert pearsonr(a, b).pvalue > 1e-4


def test_collimated_beam_has_one_direction():
    _, direction = photons(laser(divergence_full_mrad=0.0))
    assert (direction == np.array([[0], [0], [1]])).all()


STOKES = ["1, 1, 0, 0", "1 0.6 0 0.8", "1, 0, -1, 0", "1, 0.3, 0.2, -0.1", "1,0,0,0"]


@pytest.mark.parametrize("stokes", STOKES)
def test_weight_is_the_stokes_vector_about_local_x(optics, stokes):
    """In world coordinates and about Mitsuba's axes, for a laser that points anywhere."""
    energy = 0.025
    axis = [0.48, -0.8, 0.36]
    pose = mi.ScalarTransform4f().rotate(axis, 70).translate([3, 4, 5])
    plugin = laser(
        stokes=stokes,
        pulse_energy=energy,
        divergence_full_mrad=50.0,
        beam_radius=0.2,
        to_world=pose,
    )
    rng = np.random.default_rng(2)
    pairs = [mi.Point2f(*(mi.Float(rng.random(200)) for _ in range(2))) for _ in range(2)]
    ray, weight = plugin.sample_ray(mi.Float(0), mi.Float(0.5), *pairs)
    direction = np.array(ray.d).T.astype(float)
    matrix = np.array(pose.matrix).astype(float)
    local_origin, local_direction = plugin.sample_local(*pairs)
    expected = matrix[:3, :3] @ np.array(local_direction).astype(float)
    assert np.abs(direction.T - expected).max() < 1e-6
    expected = matrix[:3, :3] @ np.array(local_origin).astype(float) + matrix[:3, 3:]
    assert np.abs(np.array(ray.o) - expected).max() < 1e-5

    weight = np.array(weight)[:, :, 0]
    weight = np.broadcast_to(weight, (4, 4, 200)).transpose(2, 0, 1)
    assert (weight[:, :, 1:] == 0).all()
    # back from Mitsuba's axis to the part of local x that is across the photon's path
    x = np.broadcast_to(matrix[:3, 0], direction.shape)
    x = optics.normalized(x - direction * (x * direction).sum(1, keepdims=True))
    first, _ = optics.axes(direction)
    cosine = (first * x).sum(1)
    sine = (np.cross(first, x) * direction).sum(1)
    cos2, sin2 = cosine**2 - sine**2, 2 * sine * cosine
    i, q, u, v = weight[:, :, 0].T / energy
    found = np.stack([i, cos2 * q + sin2 * u, cos2 * u - sin2 * q, v], -1)
    given = [float(s) for s in stokes.replace(",", " ").split()]
    assert np.abs(found - given).max() < 2e-6


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"], indirect=True)
def test_unpolarised_weight_is_the_pulse_energy(variant):
    half = mi.Point2f(0.5)
    ray, weight = laser(pulse_energy=0.07).sample_ray(mi.Float(0), mi.Float(0.5), half, half)
    assert np.array(weight).ravel() == pytest.approx(0.07)
    assert len(ray.wavelengths) == 0


@pytest.mark.parametrize(
    "variant", ["llvm_ad_spectral", "llvm_ad_spectral_polarized"], indirect=True
)
def test_spectral_rays_have_the_wavelength(variant):
    half = mi.Point2f(0.5)
    ray, _ = laser(wavelength=354.7e-9).sample_ray(mi.Float(0), mi.Float(0.5), half, half)
    assert np.array(ray.wavelengths).ravel() == pytest.approx(354.7)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"beam_radius": 0.0}, "laser.beam_radius: 0.0 is not allowed; expected a finite number"),
        ({"beam_radius": -0.1}, "laser.beam_radius: -0.1 is not allowed; expected a finite number"),
        ({"beam_radius": math.inf}, "laser.beam_radius: inf is not allowed; expected a finite"),
        ({"beam_radius": math.nan}, "laser.beam_radius: nan is not allowed; expected"),
        ({"beam_radius": "wide"}, "laser.beam_radius: 'wide' is not allowed; expected a number"),
        ({"beam_cut": 0.0}, "laser.beam_cut: 0.0 is not allowed; expected"),
        ({"divergence_full_mrad": -2.0}, "laser.divergence_full_mrad: -2.0 is not allowed"),
        ({"divergence_full_mrad": math.inf}, "laser.divergence_full_mrad: inf is not allowed"),
        ({"wavelength": 0.0}, "laser.wavelength: 0.0 is not allowed; expected"),
        ({"pulse_energy": -1.0}, "laser.pulse_energy: -1.0 is not allowed; expected"),
        ({"pulse_duration": -1e-9}, "laser.pulse_duration: -1e-09 is not allowed; expected"),
        ({"stokes": "1, 0, 0"}, "laser.stokes: '1, 0, 0' is not allowed; expected four numbers"),
        ({"stokes": "1, x, 0, 0"}, "laser.stokes: '1, x, 0, 0' is not allowed; expected four"),
        ({"stokes": "2, 1, 0, 0"}, "laser.stokes: '2, 1, 0, 0' is not allowed; expected I = 1"),
        ({"stokes": "1, 1, 1, 0"}, "laser.stokes: '1, 1, 1, 0' is not allowed; expected I = 1"),
        ({"stokes": "1, nan, 0, 0"}, "laser.stokes: '1, nan, 0, 0' is not allowed; expected"),
    ],
)
def test_bad_values_are_named(parameters, message):
    with pytest.raises(RuntimeError) as error:
        laser(**parameters)
    assert message in str(error.value).splitlines()[-1]


def test_unknown_parameter_is_named():
    with pytest.raises(RuntimeError, match="beam_radus"):
        laser(beam_radus=0.1)
