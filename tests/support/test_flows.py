"""The synthetic flows themselves. Detects air that turns by a wrong angle or the wrong way, and a
texture of another contrast or correlation length than it is given."""

from functools import partial

import numpy as np
import pytest

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from tests.support.flows import axes, origin, plane_waves, texture


def test_air_turns_around_a_single_vortex():
    """By v_t dt / r, closed form."""
    vortex = Vortex(400.0, 3.0, 1.0, -2.0)
    y, z = np.array([2.0, 4.0, -9.0]), np.array([-2.5, 1.0, 7.0])
    before = origin(partial(velocity, [vortex]), y, z, 0.1)
    now, then = (a + 1j * b for a, b in ((y - 1, z + 2), (before[0] - 1, before[1] + 2)))
    r = np.abs(now)
    swirl = 400 / (2 * np.pi * r) * (1 - np.exp(-1.2564 * r**2 / 9))
    np.testing.assert_allclose(then, now * np.exp(-1j * swirl / r * 0.1), atol=1e-5)


@pytest.mark.parametrize("spacing", [1.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_texture_has_the_contrast_and_the_correlation_it_is_given(spacing):
    """exp(-(r / length)^2) over 5 seeds of 120 x 90 px: some 900 independent cells of a texture of
    3 px each, 10 % of which the random wave vectors cost; 4 standard errors are 0.06."""
    grid = np.meshgrid(*axes(120, 90, spacing))
    products = []
    for seed in range(5):
        waves = plane_waves(seed, 3.0, spacing)
        here = texture(waves, *grid) - 1
        moved = [
            texture(waves, grid[0] + spacing * dy, grid[1] + spacing * dz) - 1
            for dy, dz in ((0, 0), (3, 0), (0, 3))
        ]
        products.append([np.mean(here * other) for other in moved])
    variance, along_y, along_z = np.mean(products, axis=0) / 0.2**2
    assert variance == pytest.approx(1, abs=0.06)
    assert (along_y, along_z) == pytest.approx((np.exp(-1), np.exp(-1)), abs=0.06)
