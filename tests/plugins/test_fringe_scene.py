"""Rings from source, etalon, lens and CCD against numpy: float64, exact angles, no code of ours.

Detects: 0.05 m/s of bias, 1 % of energy between the directions of tracing, a wrong frequency,
direction or polarisation distribution, light displaced by 0.01 px at a lens, an image turned over,
an axis of Stokes vectors turned, a kernel compiled again for a new velocity.
"""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

pytestmark = pytest.mark.usefixtures("variant")

WAVELENGTH, LIGHT = 354.7e-9, 299_792_458.0
ORDER = 77248.5
SPECTRAL_RANGE = LIGHT / (ORDER * WAVELENGTH)
FOCAL, STOP = 0.3, 5e-3
# of the default: weights, offsets, sigmas
GAUSSIANS = np.array([[0.1, 0, 42e6], [0.9, 0.2e9, 1.4e9]])
LINE = {
    "type": "spectral_line",
    **{
        name: ", ".join(map(repr, column))
        for name, column in zip(("weights", "offsets", "sigmas"), GAUSSIANS.T.tolist(), strict=True)
    },
}
ETALON = {"type": "etalon", "gap": 13.7e-3, "order_fraction": 0.5, "surface_rms": 2e-9}
# an aplanatic singlet; the last test says how good it is
LENS = np.array(
    [
        [0, 0, 1e-3, 1],
        [0.1629729661, -0.7745795419, 6e-3, 1.476119988],
        [-1.142295699, 0, 0.296438162, 1],
    ]
)


def plates(to_world=None, **parameters):
    """An etalon's plates in front of the camera, or another thing in their place."""
    t = mi.ScalarTransform4f()
    place = t.translate([0.05, 0, 0]) @ (to_world or t) @ t.rotate([0, 1, 0], 90).scale(0.02)
    return {"type": "disk", "to_world": place, "bsdf": parameters}


def close(gap):
    """Two etalons, one behind the other."""
    behind = mi.ScalarTransform4f().translate([gap, 0, 0])
    more = plates(behind, **ETALON | {"line_shape": "sampled"})
    return scene(shapes=sampled() | {"more": more})


def scene(
    size=(96, 78), pixel=74e-6, estimator="camera", source=None, line=None, shapes=None, **camera
):
    """Default: the usual field on large pixels."""
    if shapes is None:
        shapes = {"plates": plates(**ETALON, line={"type": "ref", "id": "line"})}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "fringes", "estimator": estimator},
            "line": LINE | (line or {}),
            "source": {"type": "plane_waves", "line": {"type": "ref", "id": "line"}}
            | (source or {}),
            **shapes,
            "sensor": {
                "type": "ccd",
                "focal_length": FOCAL,
                "pixel": pixel,
                "stop_radius": STOP,
                "film": {
                    "type": "hdrfilm",
                    "width": size[0],
                    "height": size[1],
                    "rfilter": {"type": "box"},
                },
                **camera,
            },
        }
    )


def sampled():
    return {"plates": plates(**ETALON, line_shape="sampled")}


def render(loaded, **options):
    """Stokes vectors (4, rows, columns) and the standard error of the first, float64."""
    image = np.array(mi.render(loaded, **options)).astype(float)
    return np.moveaxis(image[..., :4], -1, 0), image[..., 4]


# --- the reference: Airy series of the line, in double precision, mean over pixels


def transmission(tan2, v_los=0.0, reflectivity=0.7):
    """At squared tangents; one curve of 1e-4 orders a step, linear in between (1e-7)."""
    nodes = np.linspace(0, tan2.max(), 90_000)
    return np.interp(tan2, nodes, _curve(1 / np.sqrt(1 + nodes), v_los, reflectivity))


def _curve(cosine, v_los, reflectivity):
    n = np.arange(1, 60)
    weight, offset, sigma = GAUSSIANS.T[:, :, None]
    t = n / SPECTRAL_RANGE
    line = (weight * np.exp(2j * np.pi * offset * t - 2 * (np.pi * sigma * t) ** 2)).sum(0)
    defects = np.exp(-2 * (np.pi * n * 2 * 2e-9 / WAVELENGTH) ** 2)
    coefficients = reflectivity**n * line * defects
    level = (1 - reflectivity) ** 2 / (1 - reflectivity**2)
    order = (ORDER + 2 * v_los / WAVELENGTH / SPECTRAL_RANGE) * cosine
    # a power series in the wave of one round trip: exp once, not for every term
    wave = np.exp(2j * np.pi * order)
    return level + 2 * level * (np.polyval([*coefficients[::-1], 0], wave)).real


def rings(
    size=(96, 78), pixel=74e-6, centre=None, v_los=0.0, field=0.016, radius=np.inf, nodes=4, **more
):
    """Fraction of the source's energy on each pixel: solid angle times transmission."""
    points, weights = np.polynomial.legendre.leggauss(nodes)
    centre = centre or ((size[0] - 1) / 2, (size[1] - 1) / 2)
    x, y = (
        (np.arange(n)[:, None] + points / 2 - c).ravel() * pixel
        for n, c in zip(size, centre, strict=True)
    )
    tan2 = (y[:, None] ** 2 + x**2) / FOCAL**2
    cosine = 1 / np.sqrt(1 + tan2)
    light = transmission(tan2, v_los, **more) * cosine**4 * np.exp(-2 * tan2 / radius**2)
    weights = np.tile(weights / 2, size[1])[:, None] * np.tile(weights / 2, size[0])
    light = (light * weights).reshape(size[1], nodes, size[0], nodes).sum((1, 3))
    sine2, w = np.polynomial.legendre.leggauss(100)
    sine2 = np.sin(field) ** 2 * (sine2 + 1) / 2
    flux = (w @ np.exp(-2 * sine2 / (1 - sine2) / radius**2)) / 2 * np.pi * np.sin(field) ** 2
    return light * pixel**2 / FOCAL**2 / flux


def assert_agree(statistics, found, error, expected, paths, least=0.0):
    """In blocks of 3 x 3 pixels: over few photons mean and standard error go together."""

    def blocks(values):
        rows, columns = values.shape
        return values.reshape(rows // 3, 3, columns // 3, 3).sum((1, 3))

    expected = blocks(expected)
    observed = expected > least * expected.max()
    statistics.assert_agree(
        blocks(found)[observed],
        np.sqrt(blocks(error**2))[observed],
        expected[observed],
        9 * paths,
        skewness=1,
    )
    total = np.sqrt((error**2).sum())
    assert blocks(found).sum() == pytest.approx(expected.sum(), abs=4 * total)


EVERY_WAY = [
    ("camera", "folded", None),
    ("camera", "sampled", None),
    ("camera", "folded", LENS),
    ("forward", "folded", None),
    ("forward", "sampled", LENS),
    ("analog", "sampled", LENS),
]


@pytest.mark.parametrize(
    ("variant", "estimator", "shape", "lens"),
    [
        pytest.param(variant, *way, id=f"{variant}-{way[0]}-{way[1]}-lens{way[2] is not None:d}")
        for variant, ways in (
            ("llvm_ad_mono_polarized", EVERY_WAY),
            ("llvm_ad_mono", EVERY_WAY[2:5:2]),
            ("llvm_ad_rgb", EVERY_WAY[::5]),
            ("cuda_ad_mono_polarized", EVERY_WAY[::3]),
        )
        for way in ways
    ],
    indirect=["variant"],
)
def test_both_directions_give_the_analytic_rings(estimator, shape, lens, statistics):
    more = {} if lens is None else {"lens": mi.TensorXf(lens.ravel())}
    shapes = sampled() if shape == "sampled" else None
    loaded = scene(estimator=estimator, shapes=shapes, line={"v_los": 70.0}, **more)
    paths = 256
    stokes, error = render(loaded, spp=paths, seed=1)
    assert_agree(statistics, stokes[0], error, rings(v_los=70.0), paths)
    if estimator == "analog":
        photons = stokes[0] * paths * stokes[0].size
        np.testing.assert_allclose(photons, np.round(photons), atol=0.01)
        assert photons.max() > 20


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
@pytest.mark.parametrize(
    ("estimator", "shape", "lens", "paths", "allowed"),
    [
        ("camera", "folded", None, 16, 0.02),
        pytest.param("camera", "folded", LENS, 64, 0.05, marks=pytest.mark.slow),
        pytest.param("forward", "sampled", LENS, 32, None, marks=pytest.mark.slow),
    ],
)
def test_velocity_of_an_image_without_noise(estimator, shape, lens, paths, allowed):
    """Full size: 960 x 780 pixels of 7.4 um. Maximum likelihood of the analytic rings.

    The camera's direction has next to no noise: 0.005 m/s, with a real lens, for which some lines
    miss the stop, 0.015 m/s; three to four sigma are allowed. Forward, within 4 sigma of its own
    Monte Carlo noise. Single precision without splitting off the orders is wrong by some m/s.
    """
    more = {} if lens is None else {"lens": mi.TensorXf(lens.ravel())}
    shapes = sampled() if shape == "sampled" else None
    size = {"size": (960, 780), "pixel": 7.4e-6}
    loaded = scene(**size, estimator=estimator, shapes=shapes, **more)
    parameters = mi.traverse(loaded)
    quarter = {"size": (480, 390), "pixel": 7.4e-6, "centre": (-0.5, -0.5), "nodes": 2}
    for v_los in (-210.0, 50.0) if lens is None else (50.0,):
        parameters["line.v_los"] = v_los
        parameters.update()
        (rendered, *_), _ = render(loaded, spp=paths, seed=2)
        rendered = (rendered + rendered[::-1] + rendered[:, ::-1] + rendered[::-1, ::-1])[
            390:, 480:
        ]
        guess = v_los + 1.0
        for _ in range(2):
            here, there = (4 * rings(**quarter, v_los=guess + d) for d in (-0.5, 0.5))
            model, slope = (here + there) / 2, there - here
            # the score of a Poisson image; its level is known
            information = (slope**2 / model).sum()
            guess += (slope / model * (rendered - model)).sum() / information
        # weights of forward paths lie below one: their noise is below that of counts
        sigma = 1 / np.sqrt(information * paths * 960 * 780)
        assert abs(guess - v_los) < (allowed or 4 * sigma)


@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
@pytest.mark.parametrize("estimator", ["camera", "forward"])
def test_uneven_light_and_a_centre_off_the_middle(estimator, statistics):
    radius = 12e-3
    source = {"radiance_radius_mrad": 1e3 * np.arctan(radius), "field_half_mrad": 22.0}
    loaded = scene(estimator=estimator, source=source, centre_x=30.25, centre_y=55.5)
    stokes, error = render(loaded, spp=256, seed=3)
    expected = rings(centre=(30.25, 55.5), field=0.022, radius=radius)
    assert expected[0, -1] < 0.2 * expected.max()
    assert_agree(statistics, stokes[0], error, expected, 256, least=0.02)


@pytest.mark.parametrize("estimator", ["camera", "forward"])
def test_image_is_upright(estimator):
    """A plate tilted towards the top left moves the rings there: top is +z, left is +y."""
    angle = np.degrees(np.array([2e-3, 3e-3]))
    t = mi.ScalarTransform4f()
    # normal (1, 0.002, 0.003)
    turn = t.rotate([0, 0, 1], angle[0]) @ t.rotate([0, 1, 0], -angle[1])
    shapes = {"plates": plates(turn, **ETALON, line={"type": "ref", "id": "line"})}
    stokes, error = render(scene(estimator=estimator, shapes=shapes), spp=256, seed=4)
    shift = FOCAL * np.tan(np.radians(angle)) / 74e-6

    def misfit(centre):
        z = (stokes[0] - rings(centre=centre)) / np.maximum(error, error.max() / 10)
        return (z**2).mean()

    middle = np.array([47.5, 38.5])
    right = misfit(tuple(middle - shift))
    # rings seen through a tilted plate are the same about its normal, but for 1e-5
    assert right < 1.1
    for signs in ((1, 1), (1, -1), (-1, 1)):
        assert misfit(tuple(middle + np.multiply(signs, shift))) > 5 * right
    assert misfit(tuple(middle - shift[::-1])) > 1.5 * right


def test_energy_that_a_stop_or_another_plate_takes():
    """A diffuse disc over the stop: nothing. A shape that bends light: an error."""
    block = {"block": plates(type="diffuse")}
    for estimator in ("camera", "forward"):
        assert (render(scene(estimator=estimator, shapes=block), spp=4)[0] == 0).all()
        clear, error = render(scene(estimator=estimator, shapes={}), spp=64, seed=5)
        expected = rings(reflectivity=1e-12)  # no mirrors
        noise = np.sqrt((error**2).sum())
        assert clear[0].sum() == pytest.approx(expected.sum(), rel=1e-6, abs=4 * noise)
    bending = scene(shapes={"glass": plates(type="dielectric")})
    with pytest.raises(ValueError, match=r"fringes.scene: .*expected surfaces that light passes"):
        bending.integrator().render(bending, spp=2)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
@pytest.mark.parametrize("estimator", ["camera", "forward"])
def test_two_etalons_see_the_same_frequency(estimator, statistics):
    """The mean of a product over the line, by quadrature: not the product of the means."""
    weaker = ETALON | {"reflectivity": 0.4, "line_shape": "sampled"}
    shapes = sampled() | {"more": plates(mi.ScalarTransform4f().translate([0.02, 0, 0]), **weaker)}
    stokes, error = render(scene(estimator=estimator, shapes=shapes), spp=256, seed=6)
    points = (np.arange(4) + 0.5) / 4 - 0.5
    x, y = ((np.arange(n)[:, None] + points - (n - 1) / 2).ravel() * 74e-6 for n in (96, 78))
    cosine = 1 / np.sqrt(1 + (y[:, None] ** 2 + x**2) / FOCAL**2)
    node, fraction = np.polynomial.hermite_e.hermegauss(24)
    fraction = fraction / fraction.sum()
    expected = np.zeros(cosine.shape)
    for weight, offset, sigma in GAUSSIANS:
        for z, s in zip(node, fraction, strict=True):
            order = ORDER * cosine + (offset + sigma * z) / SPECTRAL_RANGE
            both = np.ones(cosine.shape)
            for reflectivity in (0.7, 0.4):
                n = np.arange(40)
                defects = np.exp(-2 * (np.pi * n * 2 * 2e-9 / WAVELENGTH) ** 2)
                # cos(n phi) by Clenshaw, faster than as many cosines
                coefficients = np.where(n, 2, 1) * reflectivity**n * defects
                both *= np.polynomial.chebyshev.chebval(np.cos(2 * np.pi * order), coefficients)
                both *= (1 - reflectivity) / (1 + reflectivity)
            expected += weight * s * both
    expected = (expected * cosine**4).reshape(78, 4, 96, 4).mean((1, 3))
    expected *= (74e-6 / FOCAL) ** 2 / (np.pi * np.sin(0.016) ** 2)
    assert_agree(statistics, stokes[0], error, expected, 256)


# --- polarisation


@pytest.mark.parametrize("estimator", ["camera", "forward", "analog"])
def test_stokes_vector_of_the_source_arrives_about_the_horizontal_axis(estimator):
    """Through an etalon that knows no polarisation; then through Mitsuba's own polariser."""
    given = np.array([1, 0.5, -0.3, 0.2])
    source = {"stokes": ", ".join(map(str, given))}
    stokes, _ = render(scene(estimator=estimator, source=source), spp=64, seed=7)
    total = stokes.sum((1, 2))
    noise = 4 / np.sqrt(64 * stokes[0].size * 0.05) if estimator != "camera" else 1e-4
    np.testing.assert_allclose(total / total[0], given, atol=noise)

    # the disk's own x axis is vertical here; its y axis, which is absorbed, is horizontal
    t = mi.ScalarTransform4f()
    polariser = {
        "type": "rectangle",
        "to_world": t.translate([0.05, 0, 0]).rotate([0, 1, 0], 90).scale(0.02),
        "bsdf": {"type": "polarizer"},
    }
    stokes, _ = render(scene(estimator=estimator, source=source, shapes={"p": polariser}), spp=64)
    total = stokes.sum((1, 2)) / rings(reflectivity=1e-12).sum()
    # vertical light passes: (I - Q) / 2
    np.testing.assert_allclose(total, 0.25 * np.array([1, -1, 0, 0]), atol=noise)


@pytest.mark.parametrize("estimator", ["camera", "forward"])
@pytest.mark.parametrize(
    ("centre", "stokes_index"), [((-80.0, 15.5), 1), ((-60.0, -60.0), 2), ((-60.0, 91.0), 2)]
)
def test_coated_plates_polarise_along_the_ring(estimator, centre, stokes_index):
    """Far off the axis s and p differ: linear polarisation along the ring, the sign of T_s - T_p.

    To the right of the axis that is Q (vertical: negative); towards the corners, U.
    """
    coating = "2.1 42.2e-9, 1.48 61e-9, 2.1 60e-9"
    thin = {"type": "etalon", "gap": 3.2e-6, "coating": coating, "line_shape": "sampled"}
    t = mi.ScalarTransform4f()
    wide = {
        "type": "disk",
        "to_world": t.translate([0.05, 0, 0]).rotate([0, 1, 0], 90),
        "bsdf": thin,
    }
    loaded = scene(
        size=(32, 32),
        pixel=2.5e-3,
        estimator=estimator,
        shapes={"plates": wide},
        source={"field_half_mrad": 900.0},
        line={"sigmas": "0, 0"},
        stop_radius=1e-4,
        centre_x=centre[0],
        centre_y=centre[1],
    )
    paths = 256 if estimator == "camera" else 4096
    stokes, error = render(loaded, spp=paths, seed=8)
    x, y = np.meshgrid(*((np.arange(96) - 1) / 3 - c for c in centre))
    x, y = x * 2.5e-3, y * 2.5e-3
    sine2 = (x**2 + y**2) / (x**2 + y**2 + FOCAL**2)
    (m00, m01, *_), _ = mi.load_dict(thin).matrices(
        mi.Float(sine2.ravel()), mi.Float(0), mi.Float(0)
    )
    light = (1 - sine2) ** 2  # the pixels' solid angles
    level, linear = (np.array(m, float).reshape(sine2.shape) * light for m in (m00, m01))
    # light travels to the CCD, to -x of the scene, right of the image is -y, down is -z
    way = np.stack([-FOCAL * np.ones_like(x), x, y], -1)
    way /= np.linalg.norm(way, axis=-1, keepdims=True)

    def unit(vectors):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    s, horizontal = (unit(np.cross(axis, way)) for axis in ([1, 0, 0], [0, 0, 1]))
    cosine = (s * horizontal).sum(-1)
    sine = (np.cross(horizontal, s) * way).sum(-1)
    turned = (cosine**2 - sine**2, 2 * cosine * sine)[stokes_index - 1]
    expected = (linear * turned).sum() / level.sum()
    found = stokes[stokes_index].sum() / stokes[0].sum()
    assert abs(expected) > 0.05
    noise = np.sqrt((error**2).sum()) / stokes[0].sum()
    assert found == pytest.approx(expected, abs=0.01 * abs(expected) + 4 * noise)


def test_plane_waves_are_random_and_pure():
    """Natural light: fully polarised states, evenly on the sphere; their mean is what was asked."""
    source = mi.load_dict({"type": "plane_waves", "stokes": "1, 0.3, 0, -0.4", "line": LINE})
    n = 1 << 16
    rng = np.random.default_rng(9)

    def draw():
        return mi.Float(np.float32(rng.random(n)))

    direction, fraction, _ = source.sample_direction_of_light(mi.Point2f(draw(), draw()))
    stokes = source.sample_stokes(direction, draw(), mi.Point2f(draw(), draw()))
    stokes = np.array([np.broadcast_to(np.array(s), n) for s in stokes], float)
    np.testing.assert_allclose(np.linalg.norm(stokes[1:], axis=0), 1, atol=1e-5)
    mean = np.array([np.array(s)[0] for s in source.mean_stokes(mi.Vector3f(-1, 0, 0))])
    # Mitsuba's axis of light along x is some other than the horizontal: Q may change its sign
    assert np.linalg.norm(mean[1:3]) == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(stokes.mean(1)[3], -0.4, atol=4 / n**0.5)
    # evenly in projected solid angle: uniform in the sine's square and in azimuth
    d = np.array(direction, float)
    sine2 = d[1] ** 2 + d[2] ** 2
    assert (d[0] < 0).all() and np.all(np.array(fraction) == 1)
    assert stats.kstest(sine2 / np.sin(0.016) ** 2, "uniform").pvalue > 1e-3
    assert stats.kstest(np.arctan2(d[2], d[1]) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3


# --- the camera


def sag(height, radius, conic):
    """Depth of a surface of revolution beyond its vertex."""
    return height**2 / radius / (1 + np.sqrt(1 - (1 + conic) * height**2 / radius**2))


def snell(height, slope):
    """A meridional ray through `LENS` by angles and bisection, from the stop: place on the CCD."""
    x, y, angle, before = 0.0, height, np.arctan(slope), 1.0
    vertex = LENS[0, 2]
    for radius, conic, distance, index in LENS[1:]:
        low, high = -1e-3, 5e-3
        for _ in range(60):  # where the ray crosses vertex + sag(y)
            middle = (low + high) / 2
            here = y + (vertex + middle - x) * np.tan(angle)
            low, high = (middle, high) if middle < sag(here, radius, conic) else (low, middle)
        y += (vertex + low - x) * np.tan(angle)
        x = vertex + low
        step = 1e-7
        rise = sag(y + step, radius, conic) - sag(y - step, radius, conic)
        normal = np.arctan(rise / (2 * step))
        # the surface's normal is turned by -normal from the axis
        angle = np.arcsin(before / index * np.sin(angle + normal)) - normal
        vertex, before = vertex + distance, index
    return y + (vertex - x) * np.tan(angle)


@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
def test_lens_is_followed_to_a_thousandth_of_a_pixel():
    """Meridional rays against angles and bisection in double precision."""
    sensor = scene(size=(960, 780), pixel=7.4e-6, lens=mi.TensorXf(LENS.ravel())).sensors()[0]
    heights, slopes = np.meshgrid(np.linspace(-STOP, STOP, 9), np.linspace(-0.011, 0.011, 7))
    heights, slopes = heights.ravel(), slopes.ravel()
    # light that travels to -x and to the right (-y), from the point y = -height
    length = np.hypot(1, slopes)
    for axis in "xy":
        across, along = -heights, -slopes / length
        zero = np.zeros(len(heights))
        point = (zero, across, zero) if axis == "x" else (zero, zero, across)
        way = (-1 / length, along, zero) if axis == "x" else (-1 / length, zero, along)
        place, arrives = sensor.receive(
            mi.Point3f(*(mi.Float(v) for v in point)), mi.Vector3f(*(mi.Float(v) for v in way))
        )
        expected = np.array([snell(h, s) for h, s in zip(heights, slopes, strict=True)]) / 7.4e-6
        found = np.array(getattr(place, axis), float) - (479.5 if axis == "x" else 389.5)
        # right is -y and down is -z of the scene; the image is upright
        np.testing.assert_allclose(found, -expected, atol=2e-3)
        inside = np.abs(expected) < (479 if axis == "x" else 389)
        assert np.array_equal(np.array(arrives), inside)


def test_rays_into_the_scene_are_those_that_arrive():
    """Reciprocity: sent out from a pixel, light comes back to it, also through the lens."""
    for lens in ("ideal", mi.TensorXf(LENS.ravel())):
        sensor = scene(size=(960, 780), pixel=7.4e-6, lens=lens).sensors()[0]
        n = 1 << 12
        rng = np.random.default_rng(12)
        place = np.float32(rng.uniform((0, 0), (959, 779), (n, 2)).T)
        sample = mi.Point2f(*(mi.Float(np.float32(rng.random(n))) for _ in range(2)))
        point, direction, weight = sensor.sample_towards_scene(mi.Point2f(place), sample)
        back, arrives = sensor.receive(point, -direction)
        passed = np.array(weight) > 0
        assert passed.mean() > 0.9 and np.all(np.array(arrives)[passed])
        np.testing.assert_allclose(np.array(back)[:, passed], place[:, passed], atol=3e-3)
        # the stop's area times the pixel's solid angle
        assert np.array(weight, float).mean() == pytest.approx(
            np.pi * STOP**2 * (7.4e-6 / FOCAL) ** 2, rel=5e-3
        )


# --- Mitsuba


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_mono_polarized"], indirect=True)
def test_mitsuba_s_own_integrator_sees_the_same_rings(statistics):
    """`path` follows both lobes of the plates; the source is an environment to it."""
    loaded = scene()
    own = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 100})
    image = np.array(mi.render(loaded, integrator=own, spp=512, seed=1), float)
    image = image.reshape(78, 96, -1)[..., 0]
    solid_angle = np.pi * np.sin(0.016) ** 2
    image /= np.pi * STOP**2 * solid_angle
    expected = rings()
    # of a path, either nothing or 1 / T is returned with the probability T: 16 x 16 pixels a mean
    level = rings(reflectivity=1e-12)
    variance = expected * (level - expected) / 512
    z = (image - expected) / np.sqrt(variance)
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert z.var() == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("estimator", ["camera", "forward"])
def test_velocity_gap_and_line_need_no_compilation(estimator):
    """A first image compiles; others, of other scenes too, do not."""

    def misses(loaded, seed):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            mi.render(loaded, spp=4, seed=seed)
            history = dr.kernel_history()
        return sum(not kernel.get("cache_hit", True) for kernel in history)

    loaded = scene(estimator=estimator)
    mi.render(loaded, spp=4, seed=0)
    parameters = mi.traverse(loaded)
    for seed, v_los in enumerate((-300.0, 10.0, 250.0)):
        parameters["line.v_los"] = v_los
        parameters.update()
        assert misses(loaded, seed + 1) == 0
    del loaded, parameters
    other = ETALON | {"gap": 12e-3, "reflectivity": 0.6, "surface_rms": 1e-9}
    shapes = {"plates": plates(**other, line={"type": "ref", "id": "line"})}
    changed = scene(estimator=estimator, shapes=shapes, line={"sigmas": "1e9, 2e9"})
    assert misses(changed, 9) == 0


def test_passes_and_seeds():
    """Many passes have the expectation of one; a seed repeats itself; progress ends at the end."""
    for estimator in ("camera", "forward"):
        loaded = scene(estimator=estimator)
        whole, error = render(loaded, spp=64, seed=1)
        again, _ = render(loaded, spp=64, seed=1)
        other, _ = render(loaded, spp=64, seed=2)
        np.testing.assert_allclose(whole, again, rtol=1e-4, atol=1e-4 * whole.max())
        assert not np.allclose(whole[0], other[0], rtol=1e-4)
        loaded.integrator().samples_per_pass = 40_000
        observed = []
        loaded.integrator().progress = lambda done, total, observed=observed: observed.append(
            (done, total)
        )
        parts, _ = render(loaded, spp=64, seed=3)
        assert len(observed) > 10 and observed[-1][0] == observed[-1][1]
        noise = np.sqrt(2 * (error**2).sum())
        assert parts[0].sum() == pytest.approx(whole[0].sum(), abs=4 * noise)
        assert np.std(parts[0] - whole[0]) == pytest.approx(np.sqrt(2 * (error**2).mean()), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: scene(lens=mi.TensorXf(np.ones(7))), "ccd.lens: 'shape .7,.*' is not allowed"),
        (lambda: scene(lens="nowhere.txt"), "ccd.lens: 'nowhere.txt' is not allowed"),
        (
            lambda: scene(lens=mi.TensorXf(np.array([[0, 0, 0.1, 1.5], [1, 0, 0.3, 1.0]]).ravel())),
            "ccd.lens: .*expected a plane stop first",
        ),
        (
            lambda: scene(
                lens=mi.TensorXf(np.array([[0, 0, 0.1, 1], [1e-3, 0, 0.3, 1.0]]).ravel())
            ),
            "ccd.lens: 'light misses a surface' is not allowed",
        ),
        (lambda: scene(pixel=0.0), "ccd.pixel"),
        (lambda: scene(stop_radius=-1.0), "ccd.stop_radius"),
        (lambda: scene(centre_x=float("nan")), "ccd.centre_x"),
        (lambda: scene(source={"field_half_mrad": 1600.0}), "plane_waves.field_half_mrad"),
        (lambda: scene(source={"stokes": "1, 1, 1, 0"}), "plane_waves.stokes"),
        (lambda: scene(source={"stokes": "2, 0, 0, 0"}), "plane_waves.stokes"),
        (lambda: mi.load_dict({"type": "plane_waves"}), "plane_waves.line: 0 is not allowed"),
        (lambda: scene(estimator="both"), "fringes.estimator: 'both' is not allowed"),
        (lambda: mi.render(scene(), spp=1), "fringes.sample_count: 1 is not allowed"),
        (lambda: mi.render(close(0)), "fringes.scene: 'plates and more' is not allowed"),
        (lambda: mi.render(close(1e-5)), "fringes.scene: 'plates and more' is not allowed"),
        (
            lambda: mi.render(scene(sampler={"type": "stratified", "sample_count": 4})),
            "fringes.sampler: 'StratifiedSampler' is not allowed",
        ),
        (
            lambda: mi.render(
                mi.load_dict(
                    {
                        "type": "scene",
                        "integrator": {"type": "fringes"},
                        "s": {"type": "perspective"},
                    }
                )
            ),
            "fringes.sensor: .* expected a sensor of type 'ccd'",
        ),
        (
            lambda: mi.render(
                mi.load_dict(
                    {"type": "scene", "integrator": {"type": "fringes"}, "s": {"type": "ccd"}}
                )
            ),
            "fringes.source: .* expected an emitter of type 'plane_waves'",
        ),
    ],
)
def test_wrong_scenes_are_named(build, message):
    with pytest.raises((RuntimeError, ValueError)) as error:
        build()
    output, cause = "", error.value
    while cause is not None:
        output, cause = f"{output} {cause}", cause.__cause__ or cause.__context__
    assert re.search(message, output), output


def test_gradients_are_refused():
    """Not taken as 0: neither backward nor forward."""
    rings = scene(size=(8, 6))
    integrator = rings.integrator()
    image = dr.zeros(mi.TensorXf, (6, 8, 5))
    for call in (
        lambda: integrator.render_forward(rings, None, spp=2),
        lambda: integrator.render_backward(rings, None, image, spp=2),
    ):
        with pytest.raises(ValueError, match=r"fringes\.gradients: .* expected images alone"):
            call()
