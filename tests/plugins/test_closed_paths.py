"""Geometry of closed paths against numpy: lengths by the triangle, densities by quadrature.

Detects: a flight that misses its path by 1e-5 of it, a wrong Jacobian by 0.1 %, a density that is
not normalised or not that of the samples by 1 %, a direction into view that is never drawn.
"""

import mitsuba as mi
import numpy as np
import pytest

from plugins.closed_paths import OpenPath, ahead_density, sample_ahead, shortened
from plugins.random_numbers import generator
from plugins.resampling import choose

pytestmark = pytest.mark.usefixtures("variant")

# distance, excess, half field of view (rad), angle of the vertex off the axis (rad), reach (m)
CASES = [
    (500.0, 30.0, 25e-3, 0.0, 1e9),
    (500.0, 0.3, 0.1e-3, 0.0, 1e9),
    (520.0, 80.0, 25e-3, 40e-3, 1e9),
    (30.0, 50.0, 100e-3, 0.0, 1e9),
    (520.0, 80.0, 25e-3, 0.0, 20.0),
    (100.0, 60.0, 0.05e-3, 0.0, 1e9),
    (100.0, 1e-6, 0.05e-3, 0.0, 1e9),
]


def directions(half):
    """With this tangent of half the angle to the direction of the telescope, -z."""
    sine, cosine = 2 * half / (1 + half**2), (1 - half**2) / (1 + half**2)
    return mi.Vector3f(mi.Float(sine), mi.Float(0), mi.Float(-cosine))


def open_path(distance, excess, fov, offset, reach):
    """Telescope at the origin; the vertex along +z."""
    return OpenPath(
        mi.Vector3f(0, 0, 1),
        mi.Float(distance),
        mi.Float(excess),
        mi.Float(np.tan((fov + offset) / 2)),
        mi.Float(reach),
    )


@pytest.mark.parametrize("case", CASES)
def test_flights_close_the_path(case):
    distance, excess, *_ = case
    cosine = np.linspace(-0.999, 1, 4001)
    vertex, sine = np.array([0, distance]), np.sqrt(1 - cosine**2)
    one_plus_cosine = mi.Float(1 + cosine)

    def path(leg):
        end = vertex + np.stack([leg * sine, leg * cosine], -1)
        return leg + np.linalg.norm(end, axis=-1)

    leg = np.array(open_path(*case).leg(mi.Float(excess), one_plus_cosine), float)
    np.testing.assert_allclose(path(leg), distance + excess, rtol=1e-5)
    step = 1e-3 * leg
    slope = np.array(
        open_path(*case).slope(mi.Float(excess), one_plus_cosine, mi.Float(leg)), float
    )
    numeric = (path(leg + step) - path(leg - step)) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=1e-3)


@pytest.mark.parametrize("case", CASES)
def test_density_is_that_of_the_samples(case):
    one, excess = open_path(*case), mi.Float(case[1])
    # in tan(theta / 2), as densities may end within microradians of either pole
    edges = np.geomspace(1e-7, 1e7, 400_001)
    middle = np.sqrt(edges[1:] * edges[:-1])
    density = np.array(one.density(excess, directions(middle)), float)
    fraction = 2 * np.pi * density * 4 * middle / (1 + middle**2) ** 2 * np.diff(edges)
    assert abs(fraction.sum() - 1) < 4e-3
    number = 400_000
    rng = np.random.default_rng(1)
    drawn = one.sample(excess, mi.Point2f(rng.random((2, number)).astype(np.float32)))
    vectors = np.array(drawn, float)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=1e-5)
    across, cosine = np.hypot(*vectors[:2]), -vectors[2]
    near, far = across / (1 + np.maximum(cosine, 0)), (1 - np.minimum(cosine, 0)) / across
    half = np.sort(np.where(cosine > 0, near, far))
    # Kolmogorov-Smirnov, 4 sigma and the quadrature's error
    expected = np.interp(half, edges[1:], np.cumsum(fraction))
    empirical = (np.arange(number) + 0.5) / number
    assert np.abs(expected - empirical).max() < 2 / np.sqrt(number) + 4e-3
    # uniform azimuth
    azimuth = np.arctan2(vectors[1], vectors[0])
    for order in (1, 2):
        assert abs(np.exp(1j * order * azimuth).mean()) < 4 / np.sqrt(number)


@pytest.mark.parametrize("case", CASES)
def test_all_directions_into_view_are_drawn(case):
    distance, excess, fov, offset, reach = case
    rng = np.random.default_rng(2)
    # isotropic, and as many again close to that of the telescope and to its opposite
    cosine = rng.uniform(-1, 1, 200_000)
    cosine = np.concatenate([cosine, -1 + 10 ** rng.uniform(-9, 0, 200_000)])
    cosine = np.concatenate([cosine, 1 - 10 ** rng.uniform(-9, 0, 200_000)])
    azimuth = rng.uniform(0, 2 * np.pi, cosine.size)
    sine = np.sqrt(1 - cosine**2)
    wo = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
    # leg from the law of cosines
    path = distance + excess
    leg = (path**2 - distance**2) / (2 * (path + distance * cosine))
    end = np.array([[0], [0], [distance]]) + leg * wo
    # the axis is tilted against the direction to the vertex
    axis = np.array([np.sin(offset), 0, np.cos(offset)])
    angle = np.arccos(np.clip(axis @ end / np.linalg.norm(end, axis=0), -1, 1))
    in_view = (angle < fov * (1 - 1e-3)) & (end[2] > distance - reach)
    assert in_view.sum() > 100
    density = np.array(open_path(*case).density(mi.Float(excess), mi.Vector3f(*wo)), float)
    assert (density[in_view] > 0).all()


@pytest.mark.parametrize("gap", [1e-4, 0.1, 30.0])
@pytest.mark.parametrize("cosine", [-0.9999, -0.5, 0.99])
def test_a_shorter_flight_shortens_the_path(gap, cosine):
    """Keeps its digits where both distances to the goal hardly differ."""
    direction = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    end = np.array([0.0, 0.0, 520.0]) + 40 * direction
    expected = gap + np.linalg.norm(end) - np.linalg.norm(end - gap * direction)
    found = shortened(mi.Vector3f(end), mi.Vector3f(direction), mi.Float(gap))
    np.testing.assert_allclose(np.array(found), expected, rtol=2e-3)


@pytest.mark.parametrize(("most", "scale"), [(100.0, 0.01), (0.5, 5.0), (10.0, 1e-5), (1e-5, 10.0)])
def test_distances_ahead_have_their_density(most, scale):
    number = (np.arange(1000) + 0.5) / 1000
    drawn = np.array(sample_ahead(mi.Float(most), mi.Float(scale), mi.Float(number)), float)
    # quantiles by the inverse of the density's integral, in double precision
    expected = scale * np.expm1(np.log1p(most / scale) * number)
    np.testing.assert_allclose(drawn, expected, rtol=1e-5)
    density = np.array(ahead_density(mi.Float(drawn), mi.Float(most), mi.Float(scale)), float)
    np.testing.assert_allclose(density * (drawn + scale) * np.log1p(most / scale), 1, rtol=1e-5)


def test_one_of_several_candidates_is_unbiased():
    """Of the densities 1, 2 x and 4 x^3 from 0 to 1, for targets unlike the integrand."""
    number = 1_000_000
    rng = generator(mi.UInt32(1), mi.UInt32(2), mi.UInt32(np.arange(number)))
    tried = []
    for power in (1.0, 0.5, 0.25):
        place = mi.Float(np.array(rng.next_float32()) ** power)
        tried.append((1 + place * place, 1 + 2 * place + 4 * place**3, (place,)))
    (place,), weight = choose(rng, *tried)
    found = np.array(weight, float) * np.exp(np.array(place, float))
    assert abs(found.mean() - (np.e - 1)) < 4 * found.std() / np.sqrt(number)
