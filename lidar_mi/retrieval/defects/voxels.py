"""Voxels that stand out of all around them: hot or dead ones, hard targets."""

import numpy as np
import torch
from scipy import ndimage
from scipy.stats import norm

FALSE_ALARM = 1e-4
"""Probability that a volume of normal noise has a voxel that counts as standing out."""
# Side of the cubes, voxels, whose median absolute differences are the scale of differences.
_TILE = 12
# Height over the range of the neighbours of what no beam or gate resolves.
_UNRESOLVED = 0.5
# Fraction that may stand out; more is the air's own, as particles are.
_MOST = 0.05


def outstanding(volume: torch.Tensor, false_alarm: float = FALSE_ALARM) -> torch.Tensor:
    """Voxels that stand out of the median of their 26 neighbours.

    Of normal differences with the local scale (1.48 median absolute values over 12^3 voxels, at
    least half of that of the volume) none does at the rate of false alarms; and air that a beam
    resolves rises by less than half of the range of its neighbours. Where more than 5 % stand out,
    the air is of such voxels. A cluster is found up to 12 voxels among the 26. Corners of constant
    areas of 3^3 voxels, as saturated ones, do not stand out.

    volume (x, z, y): not finite where nothing is known.

    Returns
    -------
    torch.Tensor of bool, shape (x, z, y)
    """
    values = volume.detach().cpu().double().numpy()
    known = np.isfinite(values)
    if not known.any():
        return torch.zeros_like(volume, dtype=torch.bool)
    values = np.where(known, values, np.median(values[known]))
    around = np.ones((3, 3, 3), bool)
    around[1, 1, 1] = False
    height = values - ndimage.median_filter(values, footprint=around)
    scale = 1.4826 * np.median(np.abs(height[known]))
    local = _medians(np.where(known, np.abs(height), np.nan))
    scale = np.maximum(1.4826 * np.where(np.isfinite(local), local, 0.0), scale / 2)
    limit = norm.isf(false_alarm / known.sum() / 2)
    size = ndimage.maximum_filter(values, footprint=around) - ndimage.minimum_filter(
        values, footprint=around
    )
    impulses = known & (np.abs(height) > limit * scale) & (np.abs(height) > _UNRESOLVED * size)
    constant = (size == 0) & (height == 0)
    impulses &= ~ndimage.binary_dilation(constant, np.ones((3, 3, 3)))
    if impulses.sum() > _MOST * known.sum():
        impulses[:] = False
    return torch.as_tensor(impulses, device=volume.device)


def _medians(values: np.ndarray) -> np.ndarray:
    """Medians over cubes, at every voxel of them."""
    medians = np.empty_like(values)
    starts = [range(0, n, _TILE) for n in values.shape]
    for place in np.ndindex(*map(len, starts)):
        cube = tuple(slice(s[i], s[i] + _TILE) for s, i in zip(starts, place, strict=True))
        part = values[cube]
        medians[cube] = np.median(part[np.isfinite(part)]) if np.isfinite(part).any() else np.nan
    return medians
