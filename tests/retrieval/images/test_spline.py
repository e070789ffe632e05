"""Splines through images and volumes against waves in closed form.

Detects waves that are damped or turned between pixels, slopes of another axis, ringing from the
faces.
"""

import math

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.images.intensity import normalised, normalised_intensity
from lidar_mi.retrieval.images.settings import VOLUME_FILTER
from lidar_mi.retrieval.images.spline import band_limited
from tests.support.volumes import nodes, random_waves


def grid(rows, columns):
    return np.meshgrid(np.arange(float(rows)), np.arange(float(columns)), indexing="ij")


@pytest.mark.parametrize("length", [2.5, 4.0, 7.0])
def test_waves_are_read_between_pixels_as_they_are(length):
    """A spline through pixels would lose 1/3 of a wave of 2.5 px half way between them."""
    z, y = grid(90, 100)
    # that continue where they are mirrored at the edges
    down, across = (math.pi / (n - 1) * round(2 * (n - 1) / length) for n in (90, 100))
    image = torch.tensor(np.cos(down * z) + np.cos(across * y))
    spline, _ = band_limited(image[None], 0.0)
    at = [torch.tensor(part[25:65, 25:75] + off) for part, off in ((z, 0.5), (y, 0.25))]
    value, slope_z, slope_y = (part[0] for part in spline.sample(*(p[None] for p in at)))
    # half way between nodes 2.8 % at 2 px, falling with the fourth power of the length; what fades
    # beyond the edges reaches in by some tenths of a per cent
    most = 0.03 * (2 / length) ** 4 + 0.006
    assert float((value - torch.cos(down * at[0]) - torch.cos(across * at[1])).abs().max()) < most
    # slopes fall short a power sooner
    for slope, wave, place in ((slope_z, down, at[0]), (slope_y, across, at[1])):
        error = slope + wave * torch.sin(wave * place)
        assert float(error.abs().max()) < wave * (0.1 * (2 / length) ** 3 + 0.006)


@pytest.mark.parametrize("part", [0.0, 0.25, 0.5])
def test_volumes_are_read_between_voxels_as_they_are(part):
    """Texture of 2 voxels correlation; a spline through voxels is off by 1.4 % of it half way."""
    shape = (14, 16, 18)
    pattern = random_waves(3, length=2.0)
    volume = torch.tensor(pattern(nodes(shape)), dtype=torch.float32)
    spline, _ = band_limited([volume], 0.0, settings=VOLUME_FILTER)
    # three voxels from the faces
    at = nodes([n - 6 for n in shape]) + 3 + np.array([part, -part, part])[:, None, None, None]
    value, *slopes = spline.sample(*torch.tensor(at, dtype=torch.float32)[:, None])
    assert float((value[0] - torch.tensor(pattern(at))).square().mean().sqrt()) < 0.004
    for axis, slope in enumerate(slopes):
        move = 0.02 * np.eye(3)[axis][:, None, None, None]
        true = torch.tensor((pattern(at + move) - pattern(at - move)) / 0.04)
        assert float((slope[0] - true).square().mean().sqrt()) < 0.02 * float(true.std())


def test_brightness_of_volumes_is_from_their_common_air():
    """Offset, factor and a decay along x; bright air that only one of them sees."""
    pattern = torch.tensor(random_waves(4)(nodes((12, 16, 16))))
    x = torch.arange(12.0)[:, None, None]
    other = 1.3 * pattern + 0.4 + 0.05 * x
    valid = torch.ones_like(pattern, dtype=torch.bool)
    valid[:, :3] = False
    other = torch.where(valid, other, 20.0)
    pair = torch.stack([pattern, other])
    value, gain = normalised_intensity(pair, valid.to(pattern))
    assert float(gain[1, 0, 0, 0] * 1.3) == pytest.approx(1, abs=1e-4)
    left = (value[1] - value[0])[valid]
    assert float(left.std()) < 1e-3 and float(left.mean()) == pytest.approx(0, abs=1e-4)
    # over the whole volumes the bright air spoils both
    whole = normalised(pair)
    assert float((whole[1] - whole[0])[valid].std()) > 0.1


def test_noise_is_estimated_from_what_an_image_holds():
    """A hole has no noise: counted as if it had, 10 % of the image lost 17 % of the variance."""
    levels = []
    for seed in range(12):
        random = np.random.default_rng([71, seed])
        images = torch.tensor(0.3 * random.standard_normal((2, 80, 90)))
        for image in images:
            image[25:52, 30:57] = math.nan
        levels.append(band_limited(normalised(images))[1])
    # twelve estimates scatter by 1 % each
    assert abs(np.mean(levels) / 0.3 - 1) < 0.015
