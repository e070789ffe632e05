"""Motion finer than windows, from the residuals that it leaves.

Detects standard errors that lack turbulence below the window or state it where there is none, noise
that is taken for motion, and motion that is not seen in noise.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.correlation.unresolved_motion import Motion, Residuals, unresolved
from lidar_mi.retrieval.images.windows import Windows, averaged

SHAPE = (140, 220)
WINDOWS = Windows(SHAPE, 8, 16, 4)


def smooth(random, *shape):
    """Random fields of unit variance and a correlation length of 3 px."""
    field = torch.as_tensor(random.standard_normal((*shape, *SHAPE))).flatten(0, len(shape) - 1)
    known = torch.ones(SHAPE, dtype=torch.bool)
    field = torch.stack([averaged(part, known, 1.5) for part in field])
    return (field / field.std()).reshape(*shape, *SHAPE)


def found(motion, noise, seed):
    """Rms of the motion that is found, px: of slopes of 0.1 per px, in noise of an rms."""
    random = np.random.default_rng(seed)
    slopes = 0.1 * smooth(random, 2)
    u = motion * smooth(random, 2)
    one, other = (noise * torch.as_tensor(random.standard_normal(SHAPE)) for _ in range(2))
    given = (slopes * u).sum(0) + one
    level = torch.full(SHAPE, float(given.square().mean().sqrt()), dtype=torch.float64)
    nothing = torch.zeros_like(slopes)
    everywhere = torch.ones(SHAPE, dtype=torch.bool)
    residuals = Residuals(given, other, other, level, slopes, everywhere)
    valid = torch.ones(WINDOWS.count, dtype=torch.bool)
    result = unresolved(
        residuals, Motion(nothing, 1.0, nothing), WINDOWS, valid, 12.0, centred=True, fewest=5.0
    )
    assert result.leverage == pytest.approx(1.0)
    assert torch.equal(result.covariance[0, 1], torch.zeros(WINDOWS.count, dtype=torch.float64))
    return float(result.covariance[0, 0].mean().sqrt())


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_motion_is_found_in_noise(noise):
    """Of 0.2 px: some 500 independent places, and squares of products, each of a relative 2.8."""
    rms = np.mean([found(0.2, noise, seed) for seed in range(4)])
    assert rms == pytest.approx(0.2, rel=0.2)


def test_noise_is_no_motion():
    """Errors of the variance are about 2 sqrt(2 / pixels) noise^2 / slope^2: 0.03 px, squared."""
    assert all(found(0.0, 0.03, seed) < 0.06 for seed in range(4))
