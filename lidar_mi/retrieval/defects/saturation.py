"""Pixels at the limit of a detector: where the largest values of an image pile up."""

import numpy as np
import torch
from scipy import ndimage
from scipy.stats import binom

from lidar_mi.retrieval.images.windows import Windows

FALSE_ALARM = 1e-6
"""Probability that an image counts as saturated whose values thin out toward the largest one."""
# Values below the largest one that show how many pixels a value has.
_LEVELS = 10


def saturated(image: torch.Tensor, false_alarm: float = FALSE_ALARM) -> torch.Tensor:
    """Pixels at the largest value of an image or volume, if values pile up there.

    The number of pixels at a value falls toward the largest one. If it did not fall at all, each
    of the N pixels at the largest value and the K = 10 below would be at the largest one with a
    probability of 1 / (K + 1). More pixels there than this binomial allows at the rate of false
    alarms are saturated. Where the number falls, as in the tail of any texture, the rate is lower.

    An image of which half has the largest value is not saturated but empty. Pixels that saturated
    and were then corrected, each by a gain of its own, differ and are not found.

    image (shape (z, y), or (x, z, y) of a volume)

    Returns
    -------
    torch.Tensor of bool, shape as `image`
    """
    values, number = torch.unique(image[torch.isfinite(image)], return_counts=True)
    none = torch.zeros_like(image, dtype=torch.bool)
    if len(values) < 2:
        return none
    top, near = int(number[-1]), int(number[-1 - _LEVELS :].sum())
    chance = binom.sf(top - 1, near, 1 / min(len(values), _LEVELS + 1))
    if chance > false_alarm or 2 * top >= int(number.sum()):
        return none
    return image == values[-1]


def saturated_areas(clipped: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Saturated areas of at least half a template that do not move with the air.

    They are saturated in all images, or in one that no other has a saturated pixel for within the
    search. The remainder is texture that is cut off at its brightest spots.

    clipped (images, ...): `saturated` pixels of each image.

    Returns
    -------
    torch.Tensor of bool, shape of an image
    """
    if not bool(clipped.any()):
        return clipped[0]
    images = clipped.cpu().numpy()
    least = windows.template**windows.dims / 2
    areas = _large(np.all(images, axis=0), least)
    for number, image in enumerate(images):
        others = np.delete(images, number, 0).any(0)
        near = ndimage.maximum_filter(others, 2 * windows.search + 1)
        areas |= _large(image, least, near)
    return torch.as_tensor(areas, device=clipped.device)


def _large(pixels: np.ndarray, least: float, but: np.ndarray | None = None) -> np.ndarray:
    """Connected pixels, at least so many of them, none of them among others."""
    label, number = ndimage.label(pixels)
    size = np.bincount(label.ravel(), minlength=number + 1)
    if but is not None:
        size[label[but]] = 0
    size[0] = 0
    return size[label] >= least
