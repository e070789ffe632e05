"""Value, density and sampler at the ends of their domains: poles of scattering, rims, limits.

Detects: a density of 0 where there is light (a sample that carries an image's light alone), a
value that is lost within rounding of forward or backward, samples that follow another law than
their density within milliradians of a pole, numbers that lose their digits in a beam much wider
than its cut, a random number of 0 or next to 1 that makes NaN.
"""

import math
from importlib.resources import files
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from plugins.closed_paths import OpenPath

pytestmark = pytest.mark.usefixtures("variant")

LAST = 1 - 2.0**-24
"""The largest random number."""
NUMBER = 200_000


def steep(degrees):
    """A peak of 0.02 degrees that a table of ten nodes holds, falling by 1e5 in a cell."""
    return 1e6 * np.exp(-((degrees / 0.02) ** 2)) + 1 + 50 * np.exp(-((180 - degrees) ** 2))


def table_of(degrees, a1):
    zero, half = 0 * degrees, 0.5 * a1(degrees)
    sign = np.cos(np.radians(degrees))
    return np.column_stack([degrees, 2 * half, half, half * sign, half * sign, zero, zero])


COARSE = np.array([0, 0.1, 1, 30, 90, 150, 179, 179.9, 179.99, 180.0])
TABLES = {
    "three angles": table_of(np.array([0, 90.0, 180]), lambda t: 1 + np.cos(np.radians(t)) ** 2),
    "steep in few cells": table_of(COARSE, steep),
    "narrow cells": table_of(
        np.r_[0, np.geomspace(1e-3, 90, 60), 180 - np.geomspace(89, 1e-3, 60), 180], steep
    ),
}
AEROSOLS = ("droplets", "dust", "soot", "spheroids")


def table(name):
    if name in TABLES:
        return TABLES[name]
    return np.loadtxt(str(files("lidar_mi.scenes") / f"aerosol_{name}_532nm.txt"))


def phase_function(kind, name):
    if kind == "mueller":
        return mi.load_dict({"type": "mueller", "table": mi.TensorXf(table(name))})
    if kind == "blendphase":
        first, second = (
            {"type": "mueller", "table": mi.TensorXf(table(one))} for one in ("droplets", "soot")
        )
        return mi.load_dict({"type": kind, "weight": name, "a": first, "b": second})
    return mi.load_dict({"type": kind, "depolarization": name})


PHASES = [
    *(("mueller", name) for name in (*TABLES, *AEROSOLS)),
    ("blendphase", 0.3),
    *(("rayleigh_polarized", factor) for factor in (0.0, 0.028, 0.4)),
]


def neighbours(rng, incident, side):
    """Directions whose components are up to 4 roundings from a pole's, and up to 10 mrad off."""
    pole = side * incident
    steps = rng.integers(-4, 5, incident.shape)
    near = pole + (steps * np.spacing(np.abs(pole))).astype(np.float32)
    across = rng.standard_normal(incident.shape) * np.geomspace(1e-8, 1e-2, len(pole))[:, None]
    tilted = pole + across
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return np.concatenate([near, tilted]).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1], ids=["forward", "backward"])
@pytest.mark.parametrize("phase", PHASES, ids=str)
def test_density_follows_the_value_at_the_poles(optics, phase, side):
    """The ratio is one, except for a blend: between a1's of its parts, here one as well."""
    rng = np.random.default_rng(1)
    incident = optics.unit_vectors(rng, NUMBER // 10).astype(np.float32)
    scattered = neighbours(rng, incident, side)
    matrix, density = optics.evaluate(
        phase_function(*phase), np.concatenate([incident] * 2), scattered
    )
    assert np.isfinite(matrix).all() and (matrix[:, 0, 0] > 0).all()
    np.testing.assert_allclose(density, matrix[:, 0, 0], rtol=1e-5)
    # no more polarisation than light
    assert (np.abs(matrix) <= matrix[:, :1, :1] * (1 + 1e-5)).all()


@pytest.mark.parametrize("side", [1, -1], ids=["forward", "backward"])
def test_matrices_at_the_poles_are_those_of_dipoles(optics, side):
    """E' = E - k' (k'.E) between Mitsuba's axes, in double precision, from 1 nrad on."""
    rng = np.random.default_rng(9)
    incident = optics.unit_vectors(rng, 5000).astype(np.float32).astype(float)
    tilt = rng.standard_normal(incident.shape) * np.geomspace(1e-9, 1e-1, 5000)[:, None]
    scattered = optics.normalized(side * incident + tilt).astype(np.float32).astype(float)
    found, _ = optics.evaluate(phase_function("rayleigh_polarized", 0.0), incident, scattered)
    before, after = (np.stack(optics.axes(k), 1) for k in (incident, scattered))
    jones = np.einsum("nik,njk->nij", after, before)
    pauli = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
    expected = np.einsum("aij,njk,bkl,nil->nab", pauli, jones, pauli, jones).real
    expected *= 3 / (16 * math.pi)
    # the sign of V is a matter of convention
    expected[:, 3, 3] = np.copysign(expected[:, 3, 3], found[:, 3, 3])
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-6 * found.max())


@pytest.mark.parametrize("name", ["three angles", "droplets", "steep in few cells"])
def test_value_at_the_poles_is_the_tables(optics, name):
    """Where a1 hardly changes over the angles that float32 cannot tell apart."""
    rng = np.random.default_rng(2)
    given = table(name)
    dense = np.union1d(np.linspace(0, 180, 400_001), np.linspace(0, 1, 100_001))
    a1 = np.interp(dense, given[:, 0], given[:, 1])
    total = 2 * np.pi * np.trapezoid(a1 * np.sin(np.radians(dense)), np.radians(dense))
    incident = optics.unit_vectors(rng, NUMBER // 10).astype(np.float32)
    for side, row in ((1, 0), (-1, -1)):
        matrix, _ = optics.evaluate(phase_function("mueller", name), incident, side * incident)
        np.testing.assert_allclose(matrix[:, 0, 0], given[row, 1] / total, rtol=2e-3)


def test_tables_of_mitsuba_are_not_cut_off(world):
    """Backscatter within rounding of 180 degrees: as of the isotropic function that they hold."""
    narrow = {"divergence_full_mrad": 0.1, "beam_radius": 0.01, "beam_cut": 0.01}
    directions = mi.TensorXf(np.array([[2.0, 1.1, 0.7]]))
    images = [
        world.render(
            world.scene(
                world.lidar(
                    (1, 1),
                    (400, 410),
                    narrow,
                    fov_half_mrad=0.1,
                    aperture_radius=0.01,
                    directions=directions,
                ),
                slab=world.box((300, -900, -900), (600, 900, 900), world.homogeneous(1e-3, phase)),
            ),
            spp=20_000,
        )
        for phase in ({"type": "tabphase", "values": "1, 1, 1"}, {"type": "isotropic"})
    ]
    np.testing.assert_allclose(*(values[0, 0] for values, _ in images), rtol=1e-4)


def quadrature(given, edges):
    """Probability of rings of the sphere, for a1 linear in angle."""
    result = []
    for low, high in pairwise(edges):
        inner = given[(given[:, 0] > low) & (given[:, 0] < high), 0]
        nodes = np.concatenate(
            [np.linspace(a, b, 400) for a, b in zip([low, *inner], [*inner, high], strict=True)]
        )
        angle = np.radians(nodes)
        result.append(
            np.trapezoid(np.interp(nodes, given[:, 0], given[:, 1]) * np.sin(angle), angle)
        )
    return np.array(result)


@pytest.mark.parametrize("side", ["forward", "backward"])
@pytest.mark.parametrize("name", [*TABLES, *AEROSOLS])
def test_samples_at_the_poles_follow_the_table(optics, name, side):
    """Chi-square over rings down to 0.1 mrad, and that all rings together hold what they should.

    Random numbers of the cells on the pole's side of a node alone, where the pole is improbable.
    """
    rng = np.random.default_rng(3)
    given = table(name)
    off = np.degrees(np.r_[0, np.geomspace(1e-4, 1, 25)])
    edges = off if side == "forward" else (180 - off)[::-1]
    everything = quadrature(given, np.array([0, 180.0]))[0]
    rings = quadrature(given, edges) / everything
    share = rings.sum()
    which = (
        share * rng.random(NUMBER) if side == "forward" else 1 - share * (1 - rng.random(NUMBER))
    )
    wo, weight, _ = phase_function("mueller", name).sample(
        mi.PhaseFunctionContext(),
        optics.interaction(np.tile([0.0, 0, 1], (NUMBER, 1))),
        mi.Float(np.minimum(which, LAST)),
        mi.Point2f(mi.Float(rng.random(NUMBER)), mi.Float(rng.random(NUMBER))),
    )
    x, y, z = np.array(wo).astype(float)
    angle = np.degrees(np.arctan2(np.hypot(x, y), z))
    found, _ = np.histogram(angle, edges)
    expected = NUMBER * rings / share
    # the cell of the last edge is drawn as a whole: its own ring is left out
    keep = np.ones(len(rings), bool)
    keep[-1 if side == "forward" else 0] = False
    # rings that hold less than the steps of a random number are counted together
    enough = keep & (expected > 20) & (rings > 2**-23 * 100)
    statistic = ((found - expected)[enough] ** 2 / expected[enough]).sum()
    assert chi2.sf(statistic, enough.sum()) > 1e-4 / 14
    np.testing.assert_allclose(np.array(weight[0, 0][0]), 1, rtol=1e-5)


@pytest.mark.parametrize("phase", PHASES, ids=str)
def test_extreme_random_numbers_give_directions(optics, phase):
    ends = np.array(np.meshgrid(*[[0, 2.0**-24, 0.5, LAST]] * 3)).reshape(3, -1)
    number = ends.shape[1]
    wo, weight, pdf = phase_function(*phase).sample(
        mi.PhaseFunctionContext(),
        optics.interaction(np.tile([0.6, 0, 0.8], (number, 1))),
        mi.Float(ends[0]),
        mi.Point2f(mi.Float(ends[1]), mi.Float(ends[2])),
    )
    np.testing.assert_allclose(np.linalg.norm(np.array(wo), axis=0), 1, rtol=1e-6)
    assert (np.array(pdf) > 0).all()
    np.testing.assert_allclose(np.array(weight[0, 0][0]), 1, rtol=1e-5)


# --- beams, sources, telescope -------------------------------------------------------------------


def pairs(seed, number=NUMBER):
    rng = np.random.default_rng(seed)
    return mi.Point2f(mi.Float(rng.random(number)), mi.Float(rng.random(number)))


@pytest.mark.parametrize("cut", [1e-4, 1e-2, 1.0, math.inf])
def test_positions_of_the_laser(cut):
    """P(r) = (1 - exp(-2 r^2)) / (1 - exp(-2 cut^2)) in radii of the beam; density by the law."""
    laser = mi.load_dict({"type": "laser", "beam_radius": 1.0, "beam_cut": cut})
    inside = -math.expm1(-2 * cut**2)
    sample, weight = laser.sample_position(0.0, pairs(4))
    place, density = np.array(sample.p, float), np.array(sample.pdf, float)
    r2 = place[0] ** 2 + place[1] ** 2
    assert kstest(r2, lambda r2: -np.expm1(-2 * r2) / inside).pvalue > 1e-3
    np.testing.assert_allclose(density, 2 / math.pi / inside * np.exp(-2 * r2), rtol=1e-4)
    np.testing.assert_allclose(np.array(weight) * density, 1, rtol=1e-5)
    # as many different places as random numbers tell apart
    assert len(np.unique(r2)) > 0.9 * NUMBER


@pytest.mark.parametrize(
    "beam", [(0.1, 0.1, 2.0), (0.1, 1e-3, 0.0), (0.02, 0.05, 200.0), (0.1, 1e9, 1e-3)]
)
def test_light_of_the_laser_is_bounded(beam):
    """By the fluence on the axis, over the cosine, or by that of a point source."""
    radius, cut, divergence = beam
    laser = mi.load_dict(
        {
            "type": "laser",
            "beam_radius": radius,
            "beam_cut": cut,
            "divergence_full_mrad": divergence,
        }
    )
    rng = np.random.default_rng(5)
    place = np.column_stack(
        [*(radius * rng.standard_normal((NUMBER, 2)) * 1.5).T, np.geomspace(1e-6, 1e4, NUMBER)]
    )
    it = dr.zeros(mi.SurfaceInteraction3f, NUMBER)
    it.p = mi.Point3f(*(mi.Float(np.ascontiguousarray(c)) for c in place.T))
    for sample in (pairs(5), mi.Point2f(LAST, LAST), mi.Point2f(0, 0)):
        ds, value = laser.sample_direction(it, sample)
        value = np.array(value[0, 0][0], float)
        half = 0.5e-3 * divergence
        inside = -math.expm1(-2 * (cut / radius) ** 2)
        near = 2 / (math.pi * radius**2 * inside)
        # three half divergences are the widest direction drawn
        narrow = near * math.hypot(1, 3 * half)
        distance = np.linalg.norm(place, axis=1)
        cosine = place[:, 2] / np.hypot(
            place[:, 2], np.hypot(*place[:, :2].T) + min(cut, 3 * radius)
        )
        with np.errstate(divide="ignore"):
            wide = 2 / (math.pi * half**2 * place[:, 2] ** 2) / cosine**3 if half else 0 * distance
        assert np.isfinite(value).all() and (value >= 0).all()
        assert (value <= np.where(half * place[:, 2] > radius, wide, narrow) * (1 + 1e-4)).all()
        assert (np.array(ds.pdf) == 1).all()


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 5.0])
def test_directions_of_plane_waves(ratio):
    """P = (1 - exp(-2 s / scale)) / (1 - exp(-2 limit / scale)) of the squared sine s."""
    field = 20e-3
    waves = mi.load_dict(
        {
            "type": "plane_waves",
            "field_half_mrad": field * 1e3,
            "radiance_radius_mrad": math.atan(math.tan(field) / ratio) * 1e3,
            "line": {"type": "spectral_line"},
        }
    )
    direction, weight, _ = waves.sample_direction_of_light(pairs(6))
    _, y, z = np.array(direction, float)
    limit, scale = math.sin(field) ** 2, (math.tan(field) / ratio) ** 2
    sine2 = y**2 + z**2
    law = lambda s: np.expm1(-2 * s / scale) / math.expm1(-2 * limit / scale)  # noqa: E731
    assert kstest(sine2, law).pvalue > 1e-3
    assert (sine2 <= limit * (1 + 1e-5)).all()
    weight, radiance = (
        np.broadcast_to(np.array(weight), NUMBER),
        np.array(waves.radiance(direction)),
    )
    drawn = np.exp(-2 * sine2 / scale)
    # but at the very rim, where the direction may be rounded out of the cone
    inner = sine2 < limit * (1 - 1e-5)
    np.testing.assert_allclose((weight * drawn)[inner], radiance[inner], rtol=1e-4)


def test_lines_draw_no_gaussian_of_weight_zero():
    line = mi.load_dict(
        {
            "type": "spectral_line",
            "weights": "0, 0.1, 0, 0.9, 0",
            "offsets": "1e12, 0, 1e12, 0, 1e12",
            "sigmas": "1, 1, 1, 1, 1",
        }
    )
    which = np.r_[
        0,
        2.0**-24,
        np.nextafter(np.float32(0.1), 0),
        np.float32(0.1),
        LAST,
        np.linspace(0, LAST, 1000),
    ]
    for end in (0, LAST):
        offset = np.array(line.sample(mi.Float(which), mi.Point2f(end, end)))
        assert np.isfinite(offset).all() and (np.abs(offset) < 100).all()


@pytest.mark.parametrize("fov", [0.01, 1.0, 100.0, 1500.0])
def test_directions_of_the_field_of_view(world, fov):
    """Uniform in solid angle, inside but for rounding at the rim; and the telescope's disc."""
    from plugins.path_sampling import Lidar

    scene = world.scene(
        world.lidar((1, 1), (500, 510), fov_half_mrad=fov),
        slab=world.box((495, -20, -20), (515, 20, 20), world.homogeneous(1e-3)),
    )
    lidar, sensor = Lidar(scene, scene.sensors()[0], None), scene.sensors()[0]
    axes = mi.Frame3f(mi.Vector3f(0, 0, 1))
    rng = mi.PCG32(size=NUMBER)
    local = axes.to_local(lidar._in_field(axes, rng))
    x, y, z = np.array(local, float)
    below = (x**2 + y**2) / (1 + z)
    assert kstest(below, lambda b: b / (1 - math.cos(fov * 1e-3))).pvalue > 1e-3
    inside = np.array(sensor.in_field_of_view(axes, axes.to_world(local), sensor.m_fov_tan))
    assert (~inside).mean() < 1e-4
    disc = np.array(sensor.sample_aperture(axes, pairs(7)), float)
    r2 = (disc**2).sum(0) / np.array(sensor.aperture_area())[0] * math.pi
    assert kstest(r2, "uniform").pvalue > 1e-3


# distance, excess, half field of view, reach: as of gates near and far, narrow and wide fields
PATHS = [
    (500.0, 5.0, 5e-3, 1e9),
    (500.0, 1e-4, 1e-3, 1e9),
    (1000.0, 3.0, 0.2e-3, 1e9),
    (520.0, 80.0, 25e-3, 20.0),
    (30.0, 50.0, 0.1, 1e9),
    (2.0, 1e3, 0.5, 1e9),
    (100.0, 60.0, 0.05e-3, 1e9),
    (100.0, 1e-6, 0.05e-3, 1e9),
]


@pytest.mark.parametrize("path", PATHS, ids=str)
def test_directions_of_closed_paths_have_a_density(optics, path):
    """Wherever rounding puts them: close to the law they are drawn from, never 0."""
    distance, excess, fov, reach = path
    rng = np.random.default_rng(8)
    away = optics.vector3(optics.unit_vectors(rng, NUMBER))
    one = OpenPath(
        away, mi.Float(distance), mi.Float(excess), mi.Float(math.tan(fov / 2)), mi.Float(reach)
    )
    for sample in (pairs(8), mi.Point2f(0, 0.3), mi.Point2f(LAST, 0.3)):
        direction = one.sample(mi.Float(excess), sample)
        density = np.array(one.density(mi.Float(excess), direction))
        least, width, _ = (np.array(v, float)[0] for v in one._limits(mi.Float(excess)))
        offset = excess / distance
        least, most = least + offset, 2 + offset
        logarithm = math.log(most / least) if width > 1 else -math.log1p(-width / most)
        law = 1 / (2 * math.pi * logarithm)
        assert np.isfinite(density).all()
        assert (density >= law / most * (1 - 1e-4)).all()
        assert (density <= law / least * (1 + 1e-2)).all()
