"""Geometry of closed paths against numpy: lengths by the triangle, densities by quadrature.

Detects: a flight that misses its path by 1e-5 of it, a wrong Jacobian by 0.1 %, a density that is
not normalised or not that of the samples by 1 %, a direction into view that is never drawn.
"""

import mitsuba as mi
import numpy as np
import pytest

from plugins.closed_paths import Way

pytestmark = pytest.mark.usefixtures("variant")

# distance, budget, half field of view (rad), angle of the vertex off the axis (rad), room (m)
CASES = [
    (500.0, 30.0, 25e-3, 0.0, 1e9),
    (500.0, 0.3, 0.1e-3, 0.0, 1e9),
    (520.0, 80.0, 25e-3, 40e-3, 1e9),
    (30.0, 50.0, 100e-3, 0.0, 1e9),
    (520.0, 80.0, 25e-3, 0.0, 20.0),
]


def way(distance, budget, fov, offset, room):
    """Telescope at the origin; the vertex along +z."""
    return Way(
        mi.Vector3f(0, 0, 1),
        mi.Float(distance),
        mi.Float(budget),
        mi.Float(np.tan((fov + offset) / 2)),
        mi.Float(room),
    )


@pytest.mark.parametrize("case", CASES)
def test_flights_close_the_path(case):
    distance, budget, *_ = case
    cosine = np.linspace(-0.999, 1, 4001)
    vertex, sine = np.array([0, distance]), np.sqrt(1 - cosine**2)
    raised = mi.Float(1 + cosine)

    def path(leg):
        end = vertex + np.stack([leg * sine, leg * cosine], -1)
        return leg + np.linalg.norm(end, axis=-1)

    leg = np.array(way(*case).leg(mi.Float(budget), raised), float)
    np.testing.assert_allclose(path(leg), distance + budget, rtol=1e-5)
    step = 1e-3 * leg
    slope = np.array(way(*case).slope(mi.Float(budget), raised, mi.Float(leg)), float)
    numeric = (path(leg + step) - path(leg - step)) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=1e-3)


@pytest.mark.parametrize("case", CASES)
def test_density_is_that_of_the_samples(case):
    one, budget = way(*case), mi.Float(case[1])
    soft = case[1] / case[0]
    # solid angle in 1 + cosine, finest where it is small
    edges = np.geomspace(soft, 2 + soft, 200_001) - soft
    middle = (edges[1:] + edges[:-1]) / 2
    density = np.array(one.density(budget, mi.Float(middle)), float)
    share = 2 * np.pi * density * np.diff(edges)
    assert abs(share.sum() - 1) < 2e-3
    number = 400_000
    rng = np.random.default_rng(1)
    drawn = one.sample(budget, mi.Point2f(rng.random((2, number)).astype(np.float32)))
    vectors = np.array(drawn, float)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=1e-5)
    raised = np.sort(np.array(one.raised(drawn), float))
    # Kolmogorov-Smirnov, 4 sigma and the quadrature's error
    expected = np.interp(raised, edges[1:], np.cumsum(share))
    seen = (np.arange(number) + 0.5) / number
    assert np.abs(expected - seen).max() < 2 / np.sqrt(number) + 2e-3
    # uniform azimuth
    azimuth = np.arctan2(vectors[1], vectors[0])
    for order in (1, 2):
        assert abs(np.exp(1j * order * azimuth).mean()) < 4 / np.sqrt(number)


@pytest.mark.parametrize("case", CASES)
def test_all_directions_into_view_are_drawn(case):
    distance, budget, fov, offset, room = case
    rng = np.random.default_rng(2)
    # isotropic, and as many again close to the way home
    cosine = rng.uniform(-1, 1, 200_000)
    cosine = np.concatenate([cosine, -1 + 10 ** rng.uniform(-6, 0, 200_000)])
    azimuth = rng.uniform(0, 2 * np.pi, cosine.size)
    sine = np.sqrt(1 - cosine**2)
    wo = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
    # leg from the law of cosines
    path = distance + budget
    leg = (path**2 - distance**2) / (2 * (path + distance * cosine))
    end = np.array([[0], [0], [distance]]) + leg * wo
    # the axis is tilted against the way to the vertex
    axis = np.array([np.sin(offset), 0, np.cos(offset)])
    angle = np.arccos(np.clip(axis @ end / np.linalg.norm(end, axis=0), -1, 1))
    seen = (angle < fov * (1 - 1e-3)) & (end[2] > distance - room)
    assert seen.sum() > 100
    density = np.array(way(*case).density(mi.Float(budget), mi.Float(1 + cosine)), float)
    assert (density[seen] > 0).all()
