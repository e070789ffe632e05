"""Single scattering in layers against quadrature and differences.

Detects: a wrong node, a wrong face, a derivative without the attenuation or with a wrong sign.
"""

import numpy as np
import pytest
from scipy.integrate import quad

from lidar_mi.inversion.layers import Layers

NODES = np.arange(102.5, 120, 5.0)
EDGES = np.array([100.0, 105, 110, 113, 120])
COSINES = np.array([1.0, 0.99])
EXTINCTION = np.array([0.02, 0.05, 0.01, 0.03])


def by_quadrature(gate, cosine, factor):
    def extinction(r):
        return np.interp(r * cosine, NODES, EXTINCTION) if 100 < r * cosine < 120 else 0.0

    def signal(r):
        depth = quad(extinction, 99, r, points=NODES / cosine, limit=200)[0]
        return extinction(r) / r**2 * np.exp(-2 * factor * depth)

    low, high = EDGES[gate : gate + 2]
    kinks = [k for k in [100 / cosine, *NODES / cosine, 120 / cosine] if low < k < high]
    return quad(signal, low, high, points=kinks or None)[0]


@pytest.mark.parametrize("factor", [1.0, 0.7])
def test_signal_is_the_integral(factor):
    found, _ = Layers(NODES, EDGES, COSINES).signal(EXTINCTION, factor)
    expected = [[by_quadrature(g, c, factor) for c in COSINES] for g in range(len(EDGES) - 1)]
    # nodes lie within subdivisions, and an oblique beam enters the air within one
    np.testing.assert_allclose(found[:, 0], np.array(expected)[:, 0], rtol=5e-4)
    np.testing.assert_allclose(found[1:, 1], np.array(expected)[1:, 1], rtol=2e-3)


def test_optical_depth_is_that_of_the_whole_air():
    """The first and the last node reach half a step beyond."""
    thin = Layers(NODES, np.array([119.999, 120.0]), np.ones(1))
    total = 5 * EXTINCTION.sum()
    # half a step with the end's own value, not the trapezoid's half
    assert thin.depth(EXTINCTION).item() == pytest.approx(total, rel=1e-4)


def test_derivatives_are_differences():
    layers = Layers(NODES, EDGES, COSINES)
    _, slopes = layers.signal(EXTINCTION, 0.8)
    for node in range(len(NODES)):
        step = 1e-4 * (np.arange(len(NODES)) == node)
        ends = [layers.signal(EXTINCTION * np.exp(sign * step), 0.8)[0] for sign in (1, -1)]
        np.testing.assert_allclose(slopes[..., node], (ends[0] - ends[1]) / 2e-4, rtol=1e-6)
