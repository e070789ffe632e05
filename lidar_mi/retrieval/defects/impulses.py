"""Pixels that stand out of all around them, as no image of air does that a beam or a lens blurs."""

from collections.abc import Callable, Iterable
from functools import lru_cache, reduce

import numpy as np
import torch
from scipy.stats import norm
from torch.nn.functional import max_pool2d, pad

from lidar_mi.retrieval.images.spline import nearest
from lidar_mi.retrieval.images.windows import averaged

FALSE_ALARM = 1e-4
"""Probability that an image of normal noise has a pixel that counts as an impulse."""
THIRDS = tuple((i, j) for i in range(3) for j in range(3) if i or j)
"""Rolls by thirds of the sides: what lies at one place in both images then does so by chance."""
# Px; width of the Gaussian over which the scale of differences is estimated.
_AROUND = 8.0
# Fraction of the rms of all values below which there is no texture.
_EMPTY = 1e-3
# Times that pixels are peeled off: areas of four pixels across vanish.
_PEELS = 4
# Px about a place, or about where the air advects it, in which an impulse is looked for.
_NEAR = 2
# Impulses at one place must be so many times those that are by chance.
_BEYOND_CHANCE = 3.0
# Least fraction of its height next to an impulse that a lens or a beam blurs.
_RESOLVED = 0.15
# Most of the impulses in both images are sharp: thin smoke in images without noise
# stands out of empty air, and a twentieth of its pixels would count.
_SHARP = 0.5
# Fraction of their height by which impulses in both images differ at most.
_ALIKE = 0.3
# The neighbours.
_ADJACENT = (0, 1), (1, 0), (1, 2), (2, 1)


@lru_cache(maxsize=256)
def threshold(number: int) -> float:
    """Standard deviations that no one of so many normal values exceeds but for false alarms."""
    return float(norm.isf(FALSE_ALARM / 2 / max(number, 1)))


def height(image: torch.Tensor) -> torch.Tensor:
    """Pixels less the median of their known neighbours; NaN where unknown, or all of these are."""
    near = _neighbours(image)
    if not bool(near.isnan().any()):
        return image - _median_of_eight(near)
    ranked = near.sort(dim=0).values  # NaN last
    number = (~ranked.isnan()).sum(0, keepdim=True)
    middle = torch.cat([(number - 1).clamp(min=0) // 2, (number // 2).clamp(max=7)])
    return image - ranked.gather(0, middle).mean(0)


def _median_of_eight(values: torch.Tensor) -> torch.Tensor:
    """Mean of the middle two of (8, ...) numbers, by exchanges of pairs: a third of a sort's time.

    The merge of Batcher (1968, AFIPS Spring Joint Computer Conference 32, 307-314) of two sorted
    fours ends with the larger of the lower half and the smaller of the upper one.
    """
    four, other = (_sorted_four(*values[k : k + 4]) for k in (0, 4))
    # of sorted a and b the four smallest of all are the smaller ones of a[i] and b[3 - i]
    pairs = list(zip(four, reversed(other), strict=True))
    low = reduce(torch.maximum, (torch.minimum(*pair) for pair in pairs))
    high = reduce(torch.minimum, (torch.maximum(*pair) for pair in pairs))
    return torch.stack([low, high]).mean(0)


def _sorted_four(
    a: torch.Tensor, b: torch.Tensor, c: torch.Tensor, d: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    a, b = torch.minimum(a, b), torch.maximum(a, b)
    c, d = torch.minimum(c, d), torch.maximum(c, d)
    a, c = torch.minimum(a, c), torch.maximum(a, c)
    b, d = torch.minimum(b, d), torch.maximum(b, d)
    return a, torch.minimum(b, c), torch.maximum(b, c), d


def unresolved(image: torch.Tensor, over: torch.Tensor) -> torch.Tensor:
    """Pixels whose height is at least half of the range of their neighbours.

    Of the rim of smoke that an image resolves it is a fifth: that stands out of images without
    noise as well.
    """
    near = _neighbours(image)
    known = near.isfinite()
    most = torch.where(known, near, -torch.inf).amax(0)
    least = torch.where(known, near, torch.inf).amin(0)
    return over.abs() >= 0.5 * (most - least)


def _neighbours(image: torch.Tensor) -> torch.Tensor:
    around = pad(image[None, None], (1,) * 4, mode="replicate")[0, 0]
    rows, columns = image.shape
    places = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return torch.stack([around[i : i + rows, j : j + columns] for i, j in places])


def scale(values: torch.Tensor) -> torch.Tensor:
    """Local standard deviation of values (z, y) without those that stand out of it."""
    known = values.isfinite()
    square = values.nan_to_num(0.0).square()
    use, limit = known, threshold(int(known.sum())) ** 2
    while True:
        variance = averaged(square, use, _AROUND)
        less = known & (square <= limit * variance)
        if bool((less == use).all()) or not bool(less.any()):
            return variance.sqrt().clamp(min=_faintest(values))
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
    # next to smoke, a block of calmer air takes half of the scatter of the smoke; blocks of one
    # texture differ by less
    level = torch.maximum(level, max_pool2d(level[None], 3, 1, 1)[0] / 2)
    smooth = torch.nn.functional.interpolate(
        level[None, None], size=(rows, columns), mode="bilinear", align_corners=False
    )[0, 0]
    smooth = 1.4826 * smooth[: values.shape[0], : values.shape[1]]
    return smooth.clamp(min=_faintest(values))


def _faintest(values: torch.Tensor) -> float:
    """Scatter below which air is empty, in images without noise: nothing stands out of that."""
    known = values.isfinite()
    square = torch.where(known, values, 0.0).square().sum() / known.sum()
    return _EMPTY * float(square.sqrt())


def _peeled(image: torch.Tensor, spread: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """Impulses of an image, and of what remains without them."""
    impulses = torch.zeros_like(image, dtype=torch.bool)
    for _ in range(_PEELS):
        remaining = torch.where(impulses, torch.nan, image)
        over = height(remaining)
        new = over.abs() > threshold(over.numel()) * spread(over)
        new &= unresolved(remaining, over)
        if not bool(new.any()):
            break
        impulses |= new
    return impulses


def outstanding(pair: torch.Tensor) -> torch.Tensor:
    """Pixels (images, z, y) that stand out of the scatter in their image."""
    return torch.stack([_peeled(image, scale) for image in pair])


def sharp(pair: torch.Tensor) -> torch.Tensor:
    """Pixels (z, y) that no image of air resolves and that two have alike, however fast it moves.

    They stand out of most others in both images. Next to them nothing is left of their height: on
    average over the known ones of the four neighbours less than 0.15. Of a particle of 2 px
    (1/e^2), the smallest that can be followed, 0.23 is left. And there are three times as many as
    in images that are rolled, which have them at one place by chance, and not many more that are
    resolved.
    """
    each = torch.stack([_peeled(image, median_scale) for image in pair])
    common = each.all(0)
    if not bool(common.any()):
        return common
    rows, columns = common.shape
    turned = [each[1].roll((int(i * rows / 3), int(j * columns / 3)), (0, 1)) for i, j in THIRDS]
    # the median, as lines at rest fall on themselves
    chance = float(np.median([int((each[0] & other).sum()) for other in turned]))
    if float(common.sum()) < _BEYOND_CHANCE * chance:
        return torch.zeros_like(common)
    known = torch.where(common, torch.nan, pair)
    wide = pad(known[None], (2,) * 4, mode="replicate")[0]
    around = wide.unfold(1, 5, 1).unfold(2, 5, 1).flatten(3).nanmedian(-1).values
    excess, peak = pad(known - around, (1,) * 4, value=torch.nan), (pair - around).nan_to_num(0.0)
    adjacent = [excess[:, i : i + common.shape[0], j : j + common.shape[1]] for i, j in _ADJACENT]
    adjacent_height = torch.stack(adjacent).nanmean(0).abs()
    alike = (peak[1] - peak[0]).abs() < _ALIKE * peak.abs().amin(0)
    alone = (adjacent_height < _RESOLVED * peak.abs()).all(0) & alike & common
    if int(alone.sum()) < _SHARP * int(common.sum()):
        return torch.zeros_like(common)
    return alone


def stray(
    pair: torch.Tensor,
    candidates: torch.Tensor,
    rest: torch.Tensor,
    motions: Iterable[torch.Tensor],
) -> torch.Tensor:
    """Of `outstanding` pixels (images, z, y) those that air does not advect from one to another.

    A pixel has a match if the other image has one of at least half its height within 2 px of where
    the motion leads. If by one of the motions (2, z, y) three times as many have one as in images
    that are rolled, the texture itself is of such pixels (particles, wisps of smoke): then only
    those without a match count that are higher than all with one. Else all do that are not at
    `rest`.
    """
    candidates = candidates & ~rest
    if not bool(candidates.any()):
        return candidates
    heights = torch.stack([height(image) for image in torch.where(rest, torch.nan, pair)])
    heights = heights.nan_to_num(0.0).abs() * candidates
    for d in motions:
        matched = candidates & torch.stack([_advected(heights, way, 0, 0, d) for way in (0, 1)])
        rows, columns = d.shape[1:]
        chance = torch.stack(
            [
                (
                    candidates[0]
                    & _advected(heights, 0, int(i * rows / 3), int(j * columns / 3), d)
                ).sum()
                for i, j in THIRDS
            ]
        )
        if int(matched[0].sum()) > _BEYOND_CHANCE * float(chance.double().median()):
            return candidates & ~matched & (heights > heights[matched].max())
    return candidates


def _advected(
    heights: torch.Tensor, image: int, row: int, column: int, d: torch.Tensor
) -> torch.Tensor:
    """Pixels of an image that the other, rolled, has a match of."""
    side = 2 * _NEAR + 1
    most = max_pool2d(heights[1 - image].roll((row, column), (0, 1))[None], side, 1, _NEAR)[0]
    there = nearest(most[None], _places(d if image == 0 else -d))[0]
    return there >= heights[image] / 2


def _places(d: torch.Tensor) -> list[torch.Tensor]:
    here = torch.meshgrid(*(torch.arange(n).to(d) for n in d.shape[1:]), indexing="ij")
    return [(place + part)[None] for place, part in zip(here, d, strict=True)]
