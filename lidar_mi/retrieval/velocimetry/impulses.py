"""Pixels that stand out of all around them, as no image of air does that a beam or a lens blurs."""

import torch
from scipy.stats import norm
from torch.nn.functional import max_pool2d, pad

from lidar_mi.retrieval.velocimetry.motion import moved
from lidar_mi.retrieval.velocimetry.windows import averaged

FALSE_ALARM = 1e-4
"""Probability that an image of normal noise has a pixel that counts as an impulse."""
# Px; width of the Gaussian over which the scale of differences is estimated.
_AROUND = 8.0
# Times that pixels are peeled off: areas of four pixels across vanish.
_PEELS = 4
# Px about a place, or about where the air carries it, in which an impulse is looked for.
_NEAR = 2
# Impulses without a match over those with one, below which they are texture as these are.
_FEW = 0.1
# Fraction of its height that counts as the same impulse.
_ALIKE = 0.5


def threshold(number: int) -> float:
    """Standard deviations that no one of so many normal values exceeds but for false alarms."""
    return float(norm.isf(FALSE_ALARM / 2 / max(number, 1)))


def height(image: torch.Tensor) -> torch.Tensor:
    """Pixels less the median of their known neighbours; NaN where unknown, or all of these are."""
    around = pad(image[None, None], (1,) * 4, mode="replicate")[0, 0]
    rows, columns = image.shape
    near = torch.stack(
        [
            around[i : i + rows, j : j + columns]
            for i in range(3)
            for j in range(3)
            if (i, j) != (1, 1)
        ]
    )
    ranked = near.sort(dim=0).values  # NaN last
    number = (~near.isnan()).sum(0, keepdim=True)
    middle = torch.cat([(number - 1).clamp(min=0) // 2, (number // 2).clamp(max=7)])
    return image - ranked.gather(0, middle).mean(0)


def scale(values: torch.Tensor) -> torch.Tensor:
    """Local standard deviation of values (z, y) without those that stand out of it."""
    known = values.isfinite()
    square = values.nan_to_num(0.0).square()
    use, limit = known, threshold(known.sum()) ** 2
    while True:
        variance = averaged(square, use, _AROUND)
        less = known & (square <= limit * variance)
        if bool((less == use).all()) or not bool(less.any()):
            return variance.sqrt()
        use = less & use


def median_scale(values: torch.Tensor, size: int = 1) -> torch.Tensor:
    """The same of any distribution of which less than half stands out: 1.48 local medians."""
    size = int(2 * _AROUND) + 6 * (size - 1)
    rows, columns = (-(-n // size) * size for n in values.shape)
    wide = values.new_full((rows, columns), torch.nan)
    wide[: values.shape[0], : values.shape[1]] = values.abs()
    blocks = wide.unfold(0, size, size).unfold(1, size, size).flatten(2)
    level = blocks.nanmedian(-1).values
    level = torch.where(level.isnan(), level.nanmedian(), level)
    smooth = torch.nn.functional.interpolate(
        level[None, None], size=(rows, columns), mode="bilinear", align_corners=False
    )[0, 0]
    return 1.4826 * smooth[: values.shape[0], : values.shape[1]]


def _peeled(image: torch.Tensor, spread) -> torch.Tensor:
    """Impulses of an image, and of what is left without them."""
    found = torch.zeros_like(image, dtype=torch.bool)
    for _ in range(_PEELS):
        over = height(torch.where(found, torch.nan, image))
        new = over.abs() > threshold(over.numel()) * spread(over)
        if not bool(new.any()):
            break
        found |= new
    return found


def outstanding(pair: torch.Tensor) -> torch.Tensor:
    """Pixels (images, z, y) that stand out of the scatter in their image."""
    return torch.stack([_peeled(image, scale) for image in pair])


def in_both(pair: torch.Tensor) -> torch.Tensor:
    """Pixels (z, y) that stand out of most others in both images."""
    return torch.stack([_peeled(image, median_scale) for image in pair]).all(0)


def unmatched(
    pair: torch.Tensor, found: torch.Tensor, rest: torch.Tensor, d: torch.Tensor
) -> torch.Tensor:
    """Of `outstanding` pixels (images, z, y) those that the other image has nothing of.

    Neither about the same place, nor about where air in the motion d comes from or goes to.
    """
    heights = torch.stack([height(image) for image in torch.where(rest, torch.nan, pair)])
    heights = heights.nan_to_num(0.0)
    gone = []
    for own, other, along in ((0, 1, d), (1, 0, -d)):
        least = _ALIKE * heights[own].abs()
        size = 2 * _NEAR + 1
        most = max_pool2d(heights[other].abs()[None], size, 1, _NEAR)[0]
        there = moved(most, along)
        gone.append(found[own] & (most < least) & (there < least))
    gone = torch.stack(gone)
    others = found & ~gone & ~rest
    if int(gone.sum()) < _FEW * int(others.sum()):
        # where texture is impulses, some are not found again by chance
        gone &= heights.abs() > heights[others].abs().max()
    return gone
