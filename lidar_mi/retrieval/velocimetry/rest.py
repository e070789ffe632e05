"""What does not move with the air: saturated areas and structure at rest in two images."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.velocimetry.brightness import normalised
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.fixed_pattern import FixedPattern, fixed_pattern
from lidar_mi.retrieval.velocimetry.motion import motion_around, moved
from lidar_mi.retrieval.velocimetry.quality import Flag, non_finite
from lidar_mi.retrieval.velocimetry.saturation import saturated, saturated_areas
from lidar_mi.retrieval.velocimetry.windows import Windows, averaged, box_sum, working

# Fraction of a template at the largest value that leaves too little to see.
_SATURATED = 0.25
# Px that a spot is moved by along each axis, either way, to see whether it fits better.
_FARTHEST = 3
# Px; slower air and structure at rest look alike.
_SLOWEST = 1.0
# Sizes of the spots that are looked for, px.
_SIZES = (1, 3, 5, 9)
# Standard deviations of the image, of spots of one size, that a spot must exceed.
_OUTSTANDING = 5.0
# Rolls by thirds of the sides: what lies at one place in both images then does so by chance.
_THIRDS = tuple((i, j) for i in range(3) for j in range(3) if i or j)
# Spots alike at rest must be so many times those that are by chance.
_BEYOND_CHANCE = 3.0
# Px; width of the Gaussians over which images without spots are averaged before the motion is
# looked for.
_SOFT = 1.5


class AtRest(NamedTuple):
    """What two or more images have in common that does not move, bool in the images' shape.

    Attributes
    ----------
    piled : torch.Tensor
        Saturated pixels, of each image.
    saturated : torch.Tensor
        Areas of them of at least half a template, see `saturation.saturated_areas`.
    structure : torch.Tensor
        That of `at_rest`.
    pattern : FixedPattern
        All over the images, without these pixels.
    """

    piled: torch.Tensor
    saturated: torch.Tensor
    structure: torch.Tensor
    pattern: FixedPattern

    def left_out(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The images without the fixed pattern, NaN in place of what is at rest."""
        pixels = self.saturated | self.structure
        return [_left_out(image, pixels) for image in self.pattern.removed(images)]

    def flags(
        self, found: Displacement, images: Sequence[torch.Tensor], windows: Windows, left_out: bool
    ) -> torch.Tensor:
        """The flags of vectors, with the reasons by their names.

        Parameters
        ----------
        found : Displacement
        images : sequence of torch.Tensor
            As they are.
        windows : Windows
        left_out : bool
            The vectors are from what was `left_out` of the images. Flags of non-finite input stay
            where the images themselves hold it. Otherwise the place in image 2 counts as well, and
            of saturated areas all of the search region.
        """
        flag = found.flag
        bad = non_finite(images, windows)
        hidden = ((flag & Flag.NON_FINITE_INPUT.value) > 0) & ~bad
        flag = flag & ~(Flag.NON_FINITE_INPUT * hidden).to(flag.dtype)
        nothing = not any(bool(part.any()) for part in (self.piled, self.saturated, self.structure))
        if nothing and not self.pattern.spoils:
            return flag
        wide = ~torch.isfinite(found.d).all(0) & ~bad
        piled = windows.of_templates(working(self.piled)).amax(0) > _SATURATED
        # an area of another brightness spoils a correlation from afar
        for bit, pixels, here, reach in (
            (Flag.SATURATED, self.saturated, piled, wide if left_out else ~bad),
            (Flag.AT_REST, self.structure, torch.full_like(bad, self.pattern.spoils), wide),
        ):
            here = here | (windows.of_templates(working(pixels)) > 0)
            here |= reach & (windows.of_regions(working(pixels)) > 0)
            if not left_out:
                here |= _matched(pixels, windows, found.d)
            flag = flag | (bit * here).to(flag.dtype)
        return flag


def _matched(pixels: torch.Tensor, windows: Windows, d: torch.Tensor) -> torch.Tensor:
    """Whether there are such pixels where a template, moved by d px, lies in image 2."""
    n = windows.template
    boxes = box_sum(box_sum(working(pixels), n, -1), n, -2) > 0
    starts = [torch.tensor(windows.starts(axis), device=d.device) for axis in (0, 1)]
    row, column = (
        (start + part.nan_to_num(0.0).round().long()).clamp(0, size - 1)
        for start, part, size in zip(
            torch.meshgrid(*starts, indexing="ij"), d, boxes.shape, strict=True
        )
    )
    return boxes[row, column]


def all_at_rest(images: Sequence[torch.Tensor], windows: Windows) -> AtRest:
    """Saturated areas of images or volumes; structure and a fixed pattern at rest of images."""
    piled = torch.stack([saturated(image) for image in images])
    areas = saturated_areas(piled, windows)
    if windows.dims > 2:
        return nothing_at_rest(images)._replace(piled=piled, saturated=areas)
    pair = [_left_out(image, areas) for image in images[:2]]
    pattern = fixed_pattern(pair, windows)
    pair = pattern.removed(pair)
    structure, d = at_rest(*pair, windows)
    return AtRest(piled, areas, structure & ~areas, pattern.with_pixels(pair, d))


def nothing_at_rest(images: Sequence[torch.Tensor]) -> AtRest:
    """Images or volumes that are known to hold nothing of the kind."""
    none = torch.zeros_like(images[0], dtype=torch.bool)
    return AtRest(torch.stack([none] * len(images)), none, none, FixedPattern(torch.ones(1)))


def _left_out(image: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    if not bool(pixels.any()):
        return image
    image = image if image.is_floating_point() else working(image)
    return torch.where(pixels, torch.nan, image)


def at_rest(
    image1: torch.Tensor, image2: torch.Tensor, windows: Windows
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels with structure that stays where it is while the air around it moves.

    Spots of 1, 3, 5 and 9 px count (mean over a square less that over one three times as large):
    beyond 5 robust standard deviations in both images, and alike there to 0.3 of their height. The
    motion d around them is the median of 5 x 5 coarse vectors of the images without these spots,
    averaged over Gaussians of 1.5 px, which hide gains of pixels.
    Spots are at rest where the images differ by 0.7 of the height along d, forward from image 1
    and back from image 2, and differ least without a displacement: where a spot is all that there
    is, no d is known. Gaussian texture has one pixel beyond 5 standard deviations in two
    millions, in one image alone.

    Not found: structure where the air moves by less than a pixel, where it fills most of 5 coarse
    windows, edges, or a pattern so weak or so dense that no place stands out. Bright air that
    stands still amid moving air looks at rest, and is.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
    windows : Windows

    Returns
    -------
    structure : torch.Tensor of bool, shape (z, y)
    d : torch.Tensor, shape (2, z, y)
        Px.
    """
    first, second = normalised([image1, image2]).nan_to_num(0.0)
    means = {size: _means(first, second, size) for size in {*_SIZES, *(3 * n for n in _SIZES)}}
    spots = [_spots(means[size] - means[3 * size]) for size in _SIZES]
    candidates = torch.stack([_grown(s.alike, z) for s, z in zip(spots, _SIZES, strict=True)])
    candidates = candidates.any(0)
    soft = (_soft(image, ~candidates) for image in (image1, image2))
    d, scatter = motion_around(*soft, windows)
    if not bool(candidates.any()):
        return candidates, d
    found = torch.zeros_like(candidates)
    # without texture around, vectors scatter over the search region
    speed = d.norm(dim=0)
    known = (speed >= _SLOWEST) & (scatter < speed)
    for spot, size in zip(spots, _SIZES, strict=True):
        apart = spot.alike & spot.apart(d)
        if bool((_grown(apart, size) & known).any()):
            found |= _grown(apart & spot.still(size), size)
    return _grown(found & known, 3), d


class _Spots(NamedTuple):
    """Two images of spots of one size, and where both have alike ones that stand out."""

    one: torch.Tensor
    two: torch.Tensor
    alike: torch.Tensor

    def apart(self, d: torch.Tensor) -> torch.Tensor:
        """Where spots neither came along d nor go on."""
        off = (self.two - moved(self.one, -d)).abs(), (self.one - moved(self.two, d)).abs()
        return torch.minimum(*off) > 0.7 * torch.minimum(self.one.abs(), self.two.abs())

    def still(self, size: int) -> torch.Tensor:
        """Where squares twice as large differ less at rest than moved by up to 3 px."""
        side = 2 * size + 1
        steps = range(-_FARTHEST, _FARTHEST + 1)
        rim = (size,) * 4
        at_rest, best = None, torch.full_like(self.one, torch.inf)
        for i, j in product(steps, steps):
            off = pad((self.one - self.two.roll((i, j), (0, 1))).square(), rim)
            off = box_sum(box_sum(off, side, -1), side, -2)
            if i or j:
                best = torch.minimum(best, off)
            else:
                at_rest = off
        return at_rest < best


def _spots(pair: torch.Tensor) -> _Spots:
    one, two = pair
    least = _OUTSTANDING * 1.4826 * torch.maximum(one.abs().median(), two.abs().median())
    alike = _alike(one, two, least)
    if not bool(alike.any()):
        return _Spots(one, two, alike)
    # among many bright particles some lie by chance where others were
    rows, columns = two.shape
    turned = [two.roll((int(i * rows / 3), int(j * columns / 3)), (0, 1)) for i, j in _THIRDS]
    chance = sum(float(_alike(one, other, least).sum()) for other in turned) / len(turned)
    few = float(alike.sum()) < _BEYOND_CHANCE * chance
    return _Spots(one, two, alike & (not few))


def _alike(one: torch.Tensor, two: torch.Tensor, least: torch.Tensor) -> torch.Tensor:
    lower = torch.minimum(one.abs(), two.abs())
    return (lower > least) & ((two - one).abs() < 0.3 * lower)


def _grown(pixels: torch.Tensor, size: int) -> torch.Tensor:
    pixels = pad(pixels.double(), (size // 2,) * 4)
    return box_sum(box_sum(pixels, size, -1), size, -2) > 0


def _means(first: torch.Tensor, second: torch.Tensor, size: int) -> torch.Tensor:
    images = pad(torch.stack([first, second]), (size // 2,) * 4, "replicate")
    return box_sum(box_sum(images, size, -1), size, -2) / size**2


def _soft(image: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    image = working(image)
    return averaged(image, torch.isfinite(image) & known, _SOFT)
