"""How well warped images agree over a template: by construction."""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow.agreement import agreement
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.images.windows import Windows


def linear(images):
    nothing = torch.zeros(2, *images.shape[1:])
    valid = torch.ones(images.shape[1:], dtype=torch.bool)
    still = nothing[0]
    return Linear(nothing, nothing, still, 1.0, images, images, valid, still)


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_texture_and_noise_of_known_power(noise):
    """Correlation 1 / (1 + noise^2) of 64 pixels, in the mean over 500 templates."""
    random = np.random.default_rng(1)
    texture = random.standard_normal((90, 130))
    pair = [3 * (texture + noise * random.standard_normal(texture.shape)) + k for k in (0, 5)]
    score = agreement(linear(torch.as_tensor(np.stack(pair))), Windows((90, 130), 8, 16, 4))
    expected = 1 / (1 + noise**2)
    # of correlations of 64 pairs: variance (1 - r^2)^2 / 64, bias - r (1 - r^2) / 128
    error = 4 * (1 - expected**2) / 8 / 500**0.5 + 1e-9
    bias = expected * (1 - expected**2) / 128
    assert float(score.mean()) == pytest.approx(expected - bias, abs=error)


def test_no_contrast_has_no_correlation():
    score = agreement(linear(torch.ones(2, 40, 50)), Windows((40, 50), 8, 16, 4))
    assert bool(score.isnan().all())
