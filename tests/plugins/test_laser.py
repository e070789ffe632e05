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


# --- other integrators -------------------------------------------------------------------------

ENERGY, ALBEDO, PIXELS, SIDE = 3.0, 0.5, 16, 0.64


def lit_wall(integrator, distance, **beam):
    """A diffuse wall across the beam, in front of a camera with SIDE / PIXELS m a pixel."""
    turned = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([1, 0, 0], 180)
    fov = math.degrees(2 * math.atan(SIDE / 2))
    film = {"width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "wall": {
                "type": "rectangle",
                "to_world": turned.scale(20),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
            },
            "laser": {"type": "laser", "pulse_energy": ENERGY, **beam},
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "to_world": mi.ScalarTransform4f().look_at(
                    [0, 0, distance - 1], [0, 0, distance], [0, 1, 0]
                ),
                "film": {"type": "hdrfilm", "pixel_format": "luminance", **film},
            },
        }
    )


@pytest.mark.parametrize("integrator", ["path", "volpath", "ptracer"])
@pytest.mark.parametrize(
    ("distance", "beam"),
    [
        (50, {"beam_radius": 0.2}),
        (50, {"beam_radius": 0.2, "beam_cut": 0.15}),
        (60, {"beam_radius": 0.2, "divergence_full_mrad": 4.0}),  # drawn from directions
        (60, {"beam_radius": 0.05, "divergence_full_mrad": 8.0}),  # from the aperture
    ],
)
def test_a_lit_wall_has_the_fluence_of_the_beam(integrator, distance, beam):
    """Radiance: albedo over pi times a Gaussian's fluence, its squared radii added (4 sigma).

    Means over blocks of 4 x 4 pixels: single pixels' errors are too skewed for 12 runs.
    """
    scene = lit_wall(integrator, distance, **beam)
    runs = [_blocks(np.array(mi.render(scene, spp=64, seed=k))[..., 0]) for k in range(12)]
    mean, error = np.mean(runs, 0), np.std(runs, 0, ddof=1) / math.sqrt(len(runs))
    wide = math.hypot(beam["beam_radius"], beam.get("divergence_full_mrad", 0) * 5e-4 * distance)
    cut = beam.get("beam_cut", math.inf)
    fine = (np.arange(20 * PIXELS) + 0.5) / (20 * PIXELS) - 0.5
    r2 = (SIDE * fine) ** 2 + (SIDE * fine[:, None]) ** 2
    fluence = 2 * ENERGY / (math.pi * wide**2) * np.exp(-2 * r2 / wide**2) * (r2 <= cut**2)
    fluence /= -math.expm1(-2 * (cut / wide) ** 2)
    expected = ALBEDO / math.pi * _blocks(fluence)
    # errors of 12 runs are Student's: 5.5 is 4 sigma; the cut's edge adds that of the quadrature
    assert (np.abs(mean - expected) < 5.5 * error + 3e-3 * expected.max()).all()
    total = np.sum(runs, (1, 2)).std(ddof=1) / math.sqrt(len(runs))
    assert abs(mean.sum() - expected.sum()) < 5.5 * total + 1e-3 * expected.sum()


def _blocks(image):
    """Means over a sixteenth of the image each."""
    step = image.shape[0] // 4
    return image.reshape(4, step, 4, step).mean((1, 3))


def test_what_it_is_made_of_can_be_changed():
    scene = lit_wall("path", 50, beam_radius=0.2)
    before = np.array(mi.render(scene, spp=32))
    parameters = mi.traverse(scene)
    parameters["laser.pulse_energy"] = 2 * ENERGY
    parameters.update()
    np.testing.assert_allclose(np.array(mi.render(scene, spp=32)), 2 * before, rtol=1e-5)
    assert {f"laser.{key}" for key in ("beam_radius", "beam_cut", "divergence_full_mrad")} <= set(
        parameters.keys()
    )
    parameters["laser.beam_radius"] = -1.0
    with pytest.raises(ValueError, match=r"laser\.beam_radius: -1.* is not allowed; expected"):
        parameters.update()


def test_a_wavelength_drawn_at_random_is_refused():
    before = mi.variant()
    mi.set_variant("llvm_ad_spectral")
    try:
        with pytest.raises(RuntimeError) as caught:
            mi.render(lit_wall("path", 50), spp=4)
        assert "variant llvm_ad_spectral is not allowed" in str(caught.value.__cause__)
    finally:
        mi.set_variant(before)
