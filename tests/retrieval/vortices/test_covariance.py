"""Covariance of fitted parameters: curvature with noise in the slopes, departure of the flow.

Detects a curvature off by 2 %, one that depends on the unit of the axes or on invalid pixels, and a
departure that is that of the steepest places alone.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lidar_mi.retrieval.vortices.covariance import curvature, model_error_of
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


@pytest.mark.parametrize("larger", [1.0, 3.0])
def test_steep_places_do_not_stand_for_the_whole_image(larger):
    """Slopes five times as steep in a fifth of the image, where the departure may be larger.

    Of 0.01 m^2 over 6 px elsewhere. There are 9900 / (4 pi 36) = 22 independent values of two
    components in an image, and 12 images: their mean square scatters by sqrt(2 / 528) = 6 %, and
    the weights are not equal. With forces as they are it would be that of the steep places, 0.09.
    """
    shape, found = (90, 110), []
    steep = np.zeros(shape)
    steep[20:70, 30:70] = 1.0
    steep = gaussian_filter(steep, 4.0)
    size = 0.1 * np.sqrt(1 + (larger**2 - 1) * steep)
    for seed in range(12):
        random = np.random.default_rng([seed, 3])
        noises = [random.standard_normal(shape) for _ in range(5)]
        widths = 1.0, 1.0, 4.24, 4.24, 0.0
        unit = [gaussian_filter(n, s, mode="wrap") for n, s in zip(noises, widths, strict=True)]
        unit = [part / part.std() for part in unit]
        slope = np.stack(unit[:2]) * (0.2 + 0.8 * steep)
        residual = (slope * np.stack(unit[2:4]) * size).sum(0) + 0.05 * unit[4]
        g, r = torch.as_tensor(slope), torch.as_tensor(residual)
        noise = torch.full(shape, 0.05**2, dtype=torch.float64)
        misfit = Misfit(r, g[:1], g, torch.ones(shape, dtype=torch.bool), noise, noise)
        whole = Solution(torch.zeros(1), misfit, 1 / noise, torch.eye(1), 0.0, True)
        found.append(model_error_of(whole, 4.0, changes=True).variance)
    everywhere = np.mean(size**2)
    scatter = 3 * np.std(found, ddof=1) / np.sqrt(len(found))
    assert everywhere - scatter < np.mean(found) < 1.5 * everywhere + scatter
    assert scatter < 0.6 * everywhere
