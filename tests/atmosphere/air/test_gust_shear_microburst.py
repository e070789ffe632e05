"""Gusts, shear and microburst against their formulas. Physics tier.

Detects: a gust of half the length or twice the speed, a wind below the roughness, a frame that does
not move with the wind at the start, air that appears from nowhere. `validation.air` has the largest
outflow.
"""

import numpy as np
import pytest

from lidar_mi.atmosphere.air.gust import Gust
from lidar_mi.atmosphere.air.microburst import Microburst
from lidar_mi.atmosphere.air.shear import LinearShear, LogarithmicShear
from lidar_mi.errors import InputError


def divergence_and_gradient(air, places, h):
    gradient = np.empty((3, 3, places.shape[1]))
    for axis in range(3):
        shift = h * np.eye(3)[axis][:, None]
        gradient[axis] = np.subtract(
            air.velocity(*(places + shift), 0.0), air.velocity(*(places - shift), 0.0)
        ) / (2 * h)
    return np.einsum("iin->n", gradient), np.sqrt((gradient**2).sum((0, 1)))


# --- gust -----------------------------------------------------------------------------------


def test_shape_of_the_gust():
    gust = Gust("up", 50.0, 200.0, 12.0)
    x = np.array([199.0, 200.0, 225.0, 250.0, 275.0, 300.0, 301.0])
    u, v, w = gust.velocity(x, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(w, [0, 0, 6, 12, 6, 0, 0], atol=1e-12)
    assert not u.any() and not v.any()
    # mean over the length: half of the largest
    assert gust.velocity(np.linspace(200, 300, 10_001), 0, 0, 0)[2].mean() == pytest.approx(
        6.0, rel=1e-3
    )


@pytest.mark.parametrize(
    ("direction", "axis", "sign"), [("up", 2, 1), ("down", 2, -1), ("left", 1, 1), ("right", 1, -1)]
)
def test_direction_of_the_gust(direction, axis, sign):
    found = np.stack(Gust(direction, 50.0, 0.0, 12.0).velocity(50.0, [[3.0], [-4.0]], 7.0, 1.0))
    assert found.shape == (3, 2, 1)
    np.testing.assert_allclose(found[axis], sign * 12.0)
    assert np.abs(found).sum() == pytest.approx(24.0)


def test_gust_has_no_divergence():
    places = np.random.default_rng(1).uniform(-100, 300, (3, 200))
    divergence, _ = divergence_and_gradient(Gust("left", 50.0, 20.0, 12.0), places, 0.01)
    assert not divergence.any()


# --- shear ----------------------------------------------------------------------------------


def test_linear_shear():
    u, v, w = LinearShear(0.05, -0.02, 300.0).velocity(7.0, [1.0, 2.0], [300.0, 250.0], 3.0)
    np.testing.assert_allclose([u, v, w], [[0, -2.5], [0, 1.0], [0, 0]])


def test_logarithmic_shear():
    """MIL-F-8785C: u = W20 ln(h/z0)/ln(20/z0), z0 = 0.15 ft; the frame moves with the start."""
    foot = 0.3048
    shear = LogarithmicShear(10.0, 20 * foot, 0.15 * foot, np.pi, 300 * foot)
    assert shear.wind_at(20 * foot) == pytest.approx(10.0)
    assert shear.wind_at(300 * foot) == pytest.approx(10 * np.log(2000) / np.log(20 / 0.15))
    np.testing.assert_allclose(shear.wind_at([0.0, 0.1 * foot]), 0.0)
    heights = np.array([300.0, 20.0]) * foot
    u, v, w = shear.velocity(1.0, 2.0, heights, 0.0)
    expected = -(shear.wind_at(heights) - shear.wind_at(300 * foot))
    np.testing.assert_allclose(u, expected)
    assert u[0] == 0 and u[1] > 0  # less head wind near the ground
    np.testing.assert_allclose(v, 0, atol=1e-14)
    assert w.shape == (2,)


def test_shears_have_no_divergence():
    places = np.random.default_rng(2).uniform(20, 300, (3, 100))
    for shear in (LinearShear(0.05, 0.1, 50.0), LogarithmicShear(10.0, 6.0, 0.05, 0.4, 200.0)):
        assert not divergence_and_gradient(shear, places, 0.01)[0].any()


# --- microburst -----------------------------------------------------------------------------

BURST = Microburst(15.0, 600.0, 60.0, 400.0, -100.0)


def test_downdraft():
    """On the axis w falls to -lambda (z* - e); lambda = outflow/(0.2357 R)."""
    depth = 60 / 0.22
    u, v, w = BURST.velocity(400.0, -100.0, np.array([0.0, 1e5]), 0.0)
    np.testing.assert_allclose(w, [0.0, -15 / (0.2357 * 600) * depth * (1 - 1 / 12.5)])
    assert not u.any() and not v.any()


def test_outflow_is_radial():
    angle = np.linspace(0, 2 * np.pi, 13)
    u, v, w = BURST.velocity(400 + 300 * np.cos(angle), -100 + 300 * np.sin(angle), 80.0, 0.0)
    np.testing.assert_allclose(u * np.sin(angle), v * np.cos(angle), atol=1e-12)
    assert np.ptp(np.hypot(u, v)) < 1e-9 and np.ptp(w) < 1e-9
    assert (u * np.cos(angle) + v * np.sin(angle) > 0).all()


def test_microburst_has_no_divergence():
    random = np.random.default_rng(3)
    places = np.stack([random.uniform(-600, 1400, 300), random.uniform(-1e3, 1e3, 300)])
    places = np.vstack([places, random.uniform(5, 600, 300)])
    divergence, gradient = divergence_and_gradient(BURST, places, 0.01)
    assert np.abs(divergence).max() < 1e-6 * gradient.max()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Gust("north", 50.0, 0.0, 1.0), r"gust\.direction: 'north' is not known"),
        (lambda: Gust("up", 0.0, 0.0, 1.0), r"gust\.gradient: 0\.0 is not allowed"),
        (lambda: Gust("up", 50.0, np.nan, 1.0), r"gust\.start: nan .* a finite number"),
        (lambda: Gust("up", 50.0, 0.0, np.inf), r"gust\.speed: inf"),
        (
            lambda: LogarithmicShear(10.0, 6.0, 6.0, 0.0, 100.0),
            r"logarithmic_shear\.roughness: 6 m is not allowed",
        ),
        (lambda: Microburst(15.0, -1.0, 60.0, 0.0), r"microburst\.radius: -1\.0"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
