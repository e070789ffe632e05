"""Covariance of fitted parameters: what noise in the slopes does to the curvature of the misfit.

Detects a curvature off by 2 %, and one that depends on the unit of the axes or on invalid pixels.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.vortices.covariance import curvature
from lidar_mi.retrieval.vortices.robust_fit import Misfit, Solution


def waves(amplitude, spacing, shape=(60, 84)):
    """sin along y times cos along z, periods 7 and 6 px, and its derivatives along y and z."""
    z, y = np.meshgrid(*(np.arange(n) * s for n, s in zip(shape, reversed(spacing), strict=True)))
    k, m = 2 * np.pi / (7 * spacing[0]), 2 * np.pi / (6 * spacing[1])
    z, y = z.T, y.T
    value = amplitude * np.sin(k * y) * np.cos(m * z)
    slope = amplitude * np.stack(
        [k * np.cos(k * y) * np.cos(m * z), -m * np.sin(k * y) * np.sin(m * z)]
    )
    return torch.as_tensor(value), torch.as_tensor(slope)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.4, 0.6)])
def test_curvature_of_two_images_with_unlike_parts(spacing):
    """Images a T + N and a T: the slope of their mean has N' / 2, the misfit only a^2 T'^2."""
    shared, slope = waves(1.0, spacing)
    rest, other = waves(0.6, spacing)
    # the unlike part a quarter of a period apart, so that the slopes do not mix
    rest, other = (torch.roll(part, 6, -1) for part in (rest, other))
    mean = slope + other / 2
    valid = torch.ones_like(shared, dtype=torch.bool)
    valid[:, :14] = False
    rest[:, :14] = 1e3
    weight = 2.5 * valid.double()
    misfit = Misfit(rest, mean[None, 0], mean, valid, shared, shared)
    found = Solution(torch.zeros(1), misfit, weight, torch.eye(1), 0.0, True)
    power = (mean.square().sum(0) * weight).sum()
    expected = 1 - (other.square().sum(0) * weight).sum() / 4 / power
    assert curvature(found, spacing) == pytest.approx(float(expected), abs=0.02)


def test_images_with_nothing_in_common_have_little_curvature():
    rest, slope = waves(1.0, (1.0, 1.0))
    valid = torch.ones_like(rest, dtype=torch.bool)
    misfit = Misfit(rest, slope[None, 0], slope / 2, valid, rest, rest)
    found = Solution(torch.zeros(1), misfit, valid.double(), torch.eye(1), 0.0, True)
    assert curvature(found, (1.0, 1.0)) == pytest.approx(0.1)
