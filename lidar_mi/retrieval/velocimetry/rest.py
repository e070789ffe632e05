"""What does not move with the air: saturated areas and structure at rest in two images."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d, pad

from lidar_mi.retrieval.velocimetry.brightness import normalised
from lidar_mi.retrieval.velocimetry.correlation import cross_correlation
from lidar_mi.retrieval.velocimetry.first_pass import coarse_windows
from lidar_mi.retrieval.velocimetry.quality import Flag, non_finite
from lidar_mi.retrieval.velocimetry.windows import Windows, linear_weights, separable, working

# Pixels at the largest value for each at the values below it, at which values pile up.
_PILED = 10
# Fraction of a template at the largest value that leaves too little to see.
_SATURATED = 0.25
# Coarse vectors along each axis whose median is the motion around a place.
_AROUND = 5
# Px; slower air and structure at rest look alike.
_SLOWEST = 1.0
# Sizes of the spots that are looked for, px.
_SIZES = (1, 3, 5, 9)
# Standard deviations of the image, of spots of one size, that a spot must exceed.
_OUTSTANDING = 5.0


def saturated(image: torch.Tensor) -> torch.Tensor:
    """Pixels at the largest value of an image or volume, if values pile up there.

    The tail of a distribution falls: more than 10 times as many pixels at the last value as at each
    of the 10 before it, and at least 10, are no tail. An image that is half at its largest value
    is not saturated but empty.
    """
    finite = image[torch.isfinite(image)]
    if not finite.numel():
        return torch.zeros_like(image, dtype=torch.bool)
    values, number = torch.unique(finite, return_counts=True)
    before = number[-11:-1]
    piled = len(values) > 10 and int(number[-1]) > _PILED * max(1, int(before.max()))
    few = 2 * int(number[-1]) < finite.numel()
    return (image == values[-1]) & (piled and few)


class AtRest(NamedTuple):
    """What two or more images have in common that does not move, bool in the images' shape.

    `saturated` are areas of at least half a template, `structure` is that of `at_rest`.
    """

    saturated: torch.Tensor
    structure: torch.Tensor

    def left_out(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The images, NaN in place of what is at rest."""
        return [_left_out(image, self.saturated | self.structure) for image in images]

    def flags(
        self, images: Sequence[torch.Tensor], windows: Windows, flag: torch.Tensor
    ) -> torch.Tensor:
        """The flags of vectors from images that were `left_out`, with the reason by its name.

        Non-finite input is only what the images themselves hold.
        """
        bad = non_finite(images, windows)
        lost = ((flag & Flag.NON_FINITE_INPUT.value) > 0) & ~bad
        flag = flag & ~(Flag.NON_FINITE_INPUT * lost).to(flag.dtype)
        piled = torch.stack([windows.of_templates(working(saturated(i))) for i in images]).amax(0)
        lost &= (flag & Flag.NO_MATCH.value) > 0
        for bit, pixels, more in (
            (Flag.SATURATED, self.saturated, piled > _SATURATED),
            (Flag.AT_REST, self.structure, torch.zeros_like(lost)),
        ):
            holds = windows.of_templates(working(pixels)) > 0
            holds |= more | (lost & (windows.of_regions(working(pixels)) > 0))
            flag = flag | (bit * holds).to(flag.dtype)
        return flag


def all_at_rest(images: Sequence[torch.Tensor], windows: Windows) -> AtRest:
    """Saturated areas of images or volumes, and structure at rest of images."""
    areas = saturated_at_rest(images, windows.template)
    if windows.dims > 2:
        return AtRest(areas, torch.zeros_like(areas))
    first, second = (_left_out(image, areas) for image in images[:2])
    return AtRest(areas, at_rest(first, second, windows) & ~areas)


def _left_out(image: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    if not bool(pixels.any()):
        return image
    image = image if image.is_floating_point() else working(image)
    return torch.where(pixels, torch.nan, image)


def saturated_at_rest(images: Sequence[torch.Tensor], template: int) -> torch.Tensor:
    """Areas of at least half a template that are saturated in all images.

    Texture that is cut off at its brightest spots moves with the air: it is no such area.
    """
    both = torch.stack([saturated(image) for image in images]).all(0)
    if not bool(both.any()):
        return both
    label, number = ndimage.label(both.cpu().numpy())
    size = np.bincount(label.ravel(), minlength=number + 1)
    size[0] = 0
    return torch.as_tensor(size[label] >= template**both.ndim / 2, device=both.device)


def at_rest(image1: torch.Tensor, image2: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Pixels with structure that stays where it is while the air around it moves.

    The motion d around a place is the median of 5 x 5 coarse vectors. Structure is at rest where
    the images agree better at rest than along d, forward from image 1 and back from image 2.
    Spots of 1, 3, 5 and 9 px count (mean over a square less that over one three times as large):
    beyond 5 robust standard deviations in both images, alike there to 0.3 of their height, and
    unlike by 0.7 of it along d both ways. Gaussian texture has one such pixel in two millions in
    one image alone.

    Not found: structure where the air moves by less than a pixel, where it fills most of 5 coarse
    windows, edges, or a pattern so weak or so dense that no place stands out. Bright air that
    stands still amid moving air looks at rest, and is.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
    windows : Windows

    Returns
    -------
    torch.Tensor of bool, shape (z, y)
    """
    d = _around(image1, image2, windows)
    moving = d.norm(dim=0) >= _SLOWEST
    if not bool(moving.any()):
        return moving
    first, second = normalised([image1, image2])
    found = torch.zeros_like(moving)
    for size in _SIZES:
        found |= _spots(first, second, d, size)
    found &= moving
    return max_pool2d(found[None].double(), 3, 1, 1)[0] > 0


def _spots(first: torch.Tensor, second: torch.Tensor, d: torch.Tensor, size: int) -> torch.Tensor:
    """Pixels of spots that both images have, and that did not come along d nor go on."""
    one, two = (_mean(image, size) - _mean(image, 3 * size) for image in (first, second))
    least = torch.minimum(one.abs(), two.abs())
    outstanding = _OUTSTANDING * 1.4826 * torch.maximum(one.abs().median(), two.abs().median())
    apart = torch.minimum((two - _moved(one, -d)).abs(), (one - _moved(two, d)).abs())
    alike = (two - one).abs() < 0.3 * least
    spots = (least > outstanding) & alike & (apart > 0.7 * least)
    return max_pool2d(spots[None].double(), size, 1, size // 2)[0] > 0


def _mean(image: torch.Tensor, size: int) -> torch.Tensor:
    rim = (size // 2,) * 4
    return avg_pool2d(pad(image[None], rim, "replicate"), size, 1)[0]


def _around(image1: torch.Tensor, image2: torch.Tensor, windows: Windows) -> torch.Tensor:
    """The motion around every pixel, (2, z, y); 0 where none was found."""
    coarse = coarse_windows(windows)
    found = cross_correlation(image1, image2, coarse.template, coarse.search, coarse.stride)
    usable = (found.flag == 0) | (found.flag == Flag.NO_SUBPIXEL_FIT.value)
    d = pad(torch.where(usable, found.d, torch.nan), (_AROUND // 2,) * 4, value=torch.nan)
    d = d.unfold(1, _AROUND, 1).unfold(2, _AROUND, 1).flatten(3).nanmedian(-1).values
    weights = [
        linear_weights(coarse.centres(axis).to(d), torch.arange(n).to(d))
        for axis, n in enumerate(windows.shape)
    ]
    return separable(d.nan_to_num(0.0), weights)


def _moved(image: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    """The image read d further on, by cubics."""
    place = [torch.arange(n).to(d) for n in image.shape]
    at = [
        2 * (p + part) / (n - 1) - 1
        for p, part, n in zip(torch.meshgrid(*place, indexing="ij"), d, image.shape, strict=True)
    ]
    grid = torch.stack([at[1], at[0]], -1)[None]
    return grid_sample(image[None, None], grid, "bicubic", "border", align_corners=True)[0, 0]
