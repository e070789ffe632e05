"""Images of fronts without texture: what they cannot tell is flagged.

Detects smooth smoke whose motion through the plane is taken for wind in it with small errors, and
texture that is taken for none.
"""

import numpy as np
import pytest
import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.flow.components import _RATIO_OF_TWO, without_texture
from lidar_mi.retrieval.flow.likelihood import prepared
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.flow.variational import variational
from tests.support.flows import origin, plane_waves, texture

SHAPE = 100, 120
TEMPLATE = 8
SETTINGS = VariationalSettings()


def bare(stack):
    """Where images (images, z, y) count as without texture."""
    return without_texture(prepared(list(torch.tensor(stack)), None, 0.0, SETTINGS), TEMPLATE)


def places():
    return np.meshgrid(*(np.arange(float(n)) for n in reversed(SHAPE)))


def pair_of_vortices(y, z):
    total = np.zeros((2, *np.shape(y)))
    for at_y, at_z, strength in ((40.0, 50.0, 18.0), (80.0, 50.0, -18.0)):
        dy, dz = y - at_y, z - at_z
        square = dy**2 + dz**2 + 1e-9
        total += np.stack([-dz, dy]) * strength / square * (1 - np.exp(-square / 36))
    return total


def smoke(seed, through):
    """Eight tilted plumes at two times; the air also moves through the plane, px."""
    random = np.random.default_rng(seed)
    y, z = places()
    plumes = [
        (random.uniform(20, 100), random.uniform(20, 80), *random.uniform(6, 25, 2), tilt, strength)
        for tilt, strength in zip(
            random.normal(0, 1, (8, 2)), random.uniform(0.3, 1, 8), strict=True
        )
    ]
    images = []
    for time in (-0.5, 0.5):
        at_y, at_z = origin(pair_of_vortices, y, z, time, steps=4)
        total = np.full_like(y, 0.01)
        for centre_y, centre_z, a, b, tilt, strength in plumes:
            dy = at_y - centre_y + tilt[0] * through * time
            dz = at_z - centre_z + tilt[1] * through * time
            radius = np.hypot(dy / a, dz / b)
            total += strength / (1 + np.exp((radius - 1) * min(a, b) / 2))
        images.append(torch.tensor(total))
    return images


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("seed", [0, pytest.param(4, marks=pytest.mark.slow)])
def test_smooth_smoke_tells_no_wind(seed, noise):
    """Taken for texture, errors of 1 px were stated as 0.2 px."""
    random = np.random.default_rng(seed)
    for through in (0.0, 0.1):
        pair = [image + noise * random.standard_normal(SHAPE) for image in smoke(seed, through)]
        found = variational(*pair, noise=noise)
        assert bool((found.flag & Flag.LOW_TEXTURE.value).bool().all())


@pytest.mark.parametrize("length", [2.0, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_texture_is_texture(length, noise):
    y, z = places()
    random = np.random.default_rng(1)
    stack = [
        texture(plane_waves(2, length), y - t, z) + noise * random.standard_normal(SHAPE)
        for t in (0.0, 1.0)
    ]
    assert not bare(np.stack(stack)).any()


def test_half_of_an_image_has_texture():
    y, z = places()
    waves = texture(plane_waves(3, 3.0), y, z) - 1
    image = waves * (y > 50) + 0.01 * z
    found = bare(image[None])
    assert bool(found[:, :35].all())
    assert not bool(found[:, 65:].any())


def test_one_structure_and_two():
    """Of two independent isotropic slopes half have a smaller ratio than counts as two."""
    slopes = np.random.default_rng(4).standard_normal((20_000, 2, 2))
    weak, strong = np.linalg.eigvalsh(slopes @ slopes.transpose(0, 2, 1)).T
    share = np.mean(weak / strong < _RATIO_OF_TWO)
    assert share == pytest.approx(0.5, abs=4 * 0.5 / 20_000**0.5)


def test_pixels_that_are_masked_are_no_structure():
    """Smoke of one brightness with sharp rims, of which some are masked."""
    y, z = places()
    image = ((y - 60) ** 2 + (z - 50) ** 2 < 900).astype(float)
    masked = np.random.default_rng(6).random(SHAPE) < 0.01
    assert bool(bare(np.where(masked, np.nan, image)[None]).all())
