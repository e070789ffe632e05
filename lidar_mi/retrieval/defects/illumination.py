"""Illumination that changes between two images: a gain that grows from edge to edge."""

import numpy as np
import torch
from scipy.stats import f as fisher

from lidar_mi.retrieval.defects.faint_pattern import in_blocks
from lidar_mi.retrieval.images.windows import working

FALSE_ALARM = 1e-4
"""Probability that images of one illumination count as differing."""
# Side of the blocks, px, whose means are compared: motion hardly changes them.
_BLOCK = 16
# Blocks, along each axis, that a plane is fitted to at least.
_FEWEST = 4
# Of the brightest block; what is darker has no ratio.
_DARK = 0.05
# Of the blocks' variance, that the plane has to explain: smoke that rotates changes blocks as well,
# alike over many of them, but not in a plane (0.14 in a wake).
_LEAST = 0.3


def illumination(
    image1: torch.Tensor, image2: torch.Tensor, false_alarm: float = FALSE_ALARM
) -> torch.Tensor:
    """Gain of image 2 over image 1 that grows linearly from edge to edge, mean 1.

    The ratios of the means over blocks of 16 px are fitted by a plane. It counts where an F test
    of its slopes against the scatter of the blocks exceeds what the rate of false alarms allows,
    and where it explains 0.3 of their variance. A factor alone is left to the methods.

    image1, image2 (z, y): brightness, not below 0.

    Returns
    -------
    torch.Tensor, shape (z, y)
        1 everywhere if no plane counts, or images have less than 64 x 64 px.
    """
    none = torch.ones_like(working(image1))
    if min(none.shape) < _FEWEST * _BLOCK:
        return none
    means = np.stack([_block_means(image) for image in (image1, image2)])
    if not np.isfinite(means).any():
        return none
    bright = (means > _DARK * np.nanmax(means)).all(0)
    degrees = int(bright.sum()) - 3
    if degrees < _FEWEST**2:
        return none
    ratio = means[1, bright] / means[0, bright]
    ratio = ratio / ratio.mean() - 1
    # in pixels from the middle
    z, y = (_BLOCK * (place[bright] + 0.5) - 0.5 for place in np.indices(bright.shape))
    middle = z.mean(), y.mean()
    slopes = np.stack([z - middle[0], y - middle[1]], 1)
    plane, *_ = np.linalg.lstsq(slopes, ratio, rcond=None)
    whole, residual = np.sum(ratio**2), np.sum((ratio - slopes @ plane) ** 2)
    test = (whole - residual) / 2 > fisher.isf(false_alarm, 2, degrees) * residual / degrees
    if not test or whole - residual < _LEAST * whole:
        return none
    place = torch.meshgrid(*(torch.arange(n).to(none) for n in none.shape), indexing="ij")
    slope_z, slope_y = (float(a) * (p - p.mean()) for a, p in zip(plane, place, strict=True))
    return (1 + (slope_z + slope_y)).clamp(min=0.1)


def described(gain: torch.Tensor) -> str:
    """What to say of a gain; empty where it is 1."""
    edges = gain[-1, 0] - gain[0, 0], gain[0, -1] - gain[0, 0]
    if not any(edges):
        return ""
    along = " and ".join(
        f"{float(d):+.1%} along {axis}" for d, axis in zip(edges, "zy", strict=True)
    )
    return f"illumination changes from edge to edge by {along}"


def _block_means(image: torch.Tensor) -> np.ndarray:
    """NaN where less than half of a block is finite."""
    blocks = in_blocks(working(image)[None], _BLOCK)[0]
    many = blocks.isfinite().sum(-1) > _BLOCK**2 / 2
    means = torch.where(blocks.isfinite(), blocks, torch.nan).nanmean(-1)
    shape = [n // _BLOCK for n in image.shape]
    return torch.where(many, means, torch.nan).reshape(shape).cpu().numpy()
