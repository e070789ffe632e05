"""What does not move with the air: saturated areas and structure at rest in two images."""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from scipy import ndimage
from torch.nn.functional import pad

from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.first_pass import window_sizes
from lidar_mi.retrieval.correlation.motion import motion_around, moved
from lidar_mi.retrieval.defects import impulses
from lidar_mi.retrieval.defects.fixed_pattern import FixedPattern, fixed_pattern
from lidar_mi.retrieval.defects.saturation import saturated, saturated_areas
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.inpainting import filled_in
from lidar_mi.retrieval.images.quality import nan_at, non_finite, thick
from lidar_mi.retrieval.images.windows import Windows, averaged, box_sum, working

# Fraction of a template at the largest value that leaves too little to see.
_SATURATED = 0.25
# The same of pixels that are no air.
_HIDDEN = 0.25
# Sizes of the spots that are looked for, px.
_SIZES = (3, 5, 9)
# Part of the thresholds that suffices next to what exceeds them (hysteresis: Canny 1986, IEEE
# Trans. PAMI 8, 679-698).
_WEAK = 0.5
# Gaps of up to twice this between what stands out, px, are left out of the estimate of motion.
_GAP = 2
# Length of lines, px.
_LINE = 9
# Fraction of its height by which structure at rest differs at most.
_DIFFER = 0.3
# Pixels of structure at rest must be so many times those that are by chance.
_BEYOND_CHANCE = 3.0
# Iterations over motion and structure at rest.
_ITERATIONS = 3
# Px; width of the Gaussians over which images without spots are averaged before the motion is
# looked for.
_SOFT = 1.5


class AtRest(NamedTuple):
    """What does not move with the air, in all images or in one; bool in the images' shape.

    clipped: saturated pixels, of each image.
    saturated: areas of them of at least half a template, see `saturation.saturated_areas`.
    structure: that of `at_rest`.
    stray: pixels of each image that no other has anything of, see `at_rest`.
    pattern: all over the images, without these pixels.
    """

    clipped: torch.Tensor
    saturated: torch.Tensor
    structure: torch.Tensor
    stray: torch.Tensor
    pattern: FixedPattern

    def __str__(self) -> str:
        parts = {"at rest": self.structure, "in one image only": self.stray.any(0)}
        said = [f"{_counted(p)} {name}" for name, p in parts.items() if bool(p.any())]
        return f"masked: {', '.join(said)}" if said else ""

    @property
    def hidden(self) -> torch.Tensor:
        """Pixels (images, z, y) that are masked."""
        return self.stray | self.saturated | self.structure

    def masked(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The images without the fixed pattern, NaN in place of what is no air."""
        pairs = zip(self.pattern.removed(images), self.hidden, strict=False)
        return [nan_at(image, pixels) for image, pixels in pairs]

    def filled(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The same, with smooth values in place of what is no air."""
        pairs = zip(self.masked(images), self.hidden, strict=False)
        return [filled_in(i, pixels) if bool(pixels.any()) else i for i, pixels in pairs]

    def flags(
        self,
        displacement: Displacement,
        images: Sequence[torch.Tensor],
        windows: Windows,
        masked: bool,
    ) -> torch.Tensor:
        """The flags of vectors, with the reasons by their names.

        images: as they are.
        masked: whether the vectors are from `masked` images. If not, pixels where the template lies
            in image 2 count as well, and saturated areas count in all of the search region.
        """
        flag = displacement.flag
        bad = non_finite(images, windows)
        # that the mask is not finite is no reason
        by_mask = ((flag & Flag.NON_FINITE_INPUT.value) > 0) & ~bad
        flag = flag & ~(Flag.NON_FINITE_INPUT * by_mask).to(flag.dtype)
        parts = self.clipped, self.saturated, self.structure, self.stray
        if not any(bool(part.any()) for part in parts) and not self.pattern.spoils:
            return flag
        lost = ~torch.isfinite(displacement.d).all(0) & ~bad
        clipped = windows.of_templates(working(self.clipped)).amax(0) > _SATURATED
        spoiled = torch.full_like(bad, self.pattern.spoils)
        hidden = self.hidden.any(0)
        spoiled |= windows.of_templates(working(hidden)) > _HIDDEN
        spoiled |= windows.of_centres(working(hidden)) > 0
        # single masked lines leave a vector enough of the air
        not_air = thick(hidden) if masked else hidden
        for bit, pixels, here, reach in (
            # an area of another brightness spoils a correlation from afar
            (Flag.SATURATED, self.saturated, clipped, lost if masked else ~bad),
            (Flag.AT_REST, not_air, spoiled, lost),
        ):
            here = here | (windows.of_templates(working(pixels)) > 0)
            here |= reach & (windows.of_regions(working(pixels)) > 0)
            if not masked:
                here |= _matched(pixels, windows, displacement.d)
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
    clipped = torch.stack([saturated(image) for image in images])
    areas = saturated_areas(clipped, windows)
    if windows.dims > 2:
        return nothing_at_rest(images)._replace(clipped=clipped, saturated=areas)
    pair = [nan_at(image, areas) for image in images[:2]]
    structure, stray, d = at_rest(pair[0], pair[1], windows)
    hidden = stray | structure
    pattern = fixed_pattern([nan_at(i, p) for i, p in zip(pair, hidden, strict=True)], windows)
    if pattern.columns or pattern.rows:
        even = pattern.removed(pair)
        structure, stray, d = at_rest(even[0], even[1], windows)
    more = torch.zeros_like(clipped[2:])
    defects = AtRest(clipped, areas, structure & ~areas, torch.cat([stray, more]), pattern)
    return defects._replace(pattern=pattern.with_pixels(defects.filled(images)[:2], d))


def nothing_at_rest(images: Sequence[torch.Tensor]) -> AtRest:
    """Images or volumes that are known to hold nothing of the kind."""
    none = torch.zeros_like(images[0], dtype=torch.bool)
    all_none = torch.stack([none] * len(images))
    return AtRest(all_none, none, none, all_none, FixedPattern(torch.ones(1)))


def at_rest(
    image1: torch.Tensor, image2: torch.Tensor, windows: Windows
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pixels that do not move with the air around them.

    They are impulses that both images have at one place and no image of air resolves
    (`impulses.sharp`); pixels, lines, steps and spots that stand out of both images and are more
    alike at one place than along the motion d of what is around; and gaps of 2 px between them.
    d is the median of 5 x 5 coarse vectors of the images without what stands out of both, averaged
    over Gaussians of 1.5 px, which hide gains of pixels. Motion and structure are estimated
    iteratively.
    What stands out is measured by local medians, with thresholds of one false alarm in 10 000
    images of normal noise: the slower the air, the stronger a structure must be to be known from
    it. What stands out of both next to it is part of it. Stray pixels stand out of one image alone
    (`impulses.stray`).

    Not found: soft structure as faint as the texture, and a pattern so weak or so dense that no
    place stands out. Bright air that stands still
    amid moving air counts as structure at rest.

    image1, image2 (z, y)

    Returns
    -------
    structure : torch.Tensor of bool, shape (z, y)
    stray : torch.Tensor of bool, shape (2, z, y)
    d : torch.Tensor, shape (2, z, y)
        Px.
    """
    pair = torch.stack([working(image) for image in (image1, image2)])
    pair = torch.where(pair.isfinite(), pair, torch.nan)
    outstanding = impulses.outstanding(pair)
    pair = _normalised(pair, outstanding)
    structure = impulses.sharp(pair)
    detectors = [*map(_stored, _detectors(pair))]
    hidden = outstanding | _candidates(detectors, structure)
    for _ in range(_ITERATIONS):
        soft = [_soft(image, ~(p | structure)) for image, p in zip(pair, hidden, strict=True)]
        motions = _motions(soft, windows)
        d = next(motions)
        if not bool(d.any()):  # what stands out is all that there is
            return structure, torch.zeros_like(outstanding), d
        stray = impulses.stray(pair, outstanding, structure, chain([d], motions))
        known = torch.where(stray, torch.nan, pair)
        new = _still([*_detectors(known)] if bool(stray.any()) else detectors, structure, d)
        if not bool((new & ~structure).any()):
            break
        structure = structure | new
    return structure, stray & ~structure, d


def _motions(images: Sequence[torch.Tensor], windows: Windows) -> Iterator[torch.Tensor]:
    """The motion around every pixel (2, z, y), from large windows, then from smaller ones.

    As in `first_pass`: in strong shear particles do not correlate in large ones.
    """
    for size in window_sizes(windows):
        yield motion_around(images[0], images[1], size, continued=True)[0]


def _normalised(pair: torch.Tensor, but: torch.Tensor) -> torch.Tensor:
    """Images with mean 0 and standard deviation 1 of all but some pixels."""
    known = pair.isfinite() & ~but
    parts = []
    for image, use in zip(pair, known, strict=True):
        values = image[use]
        contrast = values.std(correction=0) if values.numel() else image.new_ones(())
        mean = values.mean() if values.numel() else 0.0
        parts.append((image - mean) / torch.where(contrast > 0, contrast, 1.0))
    return torch.stack(parts)


class _Field(NamedTuple):
    """What may stand out of two images.

    Its values (2, z, y), by how much these or the pixels themselves differ (z, y), its size in px,
    the pixels that it marks, and the height (z, y) that no value exceeds by chance.
    """

    pair: torch.Tensor
    change: torch.Tensor
    size: int
    marked: Callable[[torch.Tensor], torch.Tensor]
    least: torch.Tensor


_Detector = Callable[[torch.Tensor], _Field]
"""From pixels (z, y) that are left out to a field of the two images without them."""
R = TypeVar("R")


def _stored(function: Callable[[torch.Tensor], R]) -> Callable[[torch.Tensor], R]:
    """A function of pixels (z, y) that computes what it gave last only once."""
    last: list[tuple[torch.Tensor, R]] = []

    def of_last(hidden: torch.Tensor) -> R:
        if not (last and torch.equal(last[0][0], hidden)):
            last[:] = [(hidden, function(hidden))]
        return last[0][1]

    return of_last


def _detectors(pair: torch.Tensor) -> Iterator[_Detector]:
    """Single pixels, lines, edges, spots: each from the images without what was found before."""
    difference = (pair[1] - pair[0]).abs().nan_to_num(torch.inf)

    def known(hidden: torch.Tensor) -> torch.Tensor:
        return torch.where(hidden, torch.nan, pair)

    def field_of(
        values: torch.Tensor,
        size: int,
        marked: Callable[[torch.Tensor], torch.Tensor],
        difference: torch.Tensor | None = None,
    ) -> _Field:
        change = (values[1] - values[0]).nan_to_num(0.0).abs()
        change = change if difference is None else change.minimum(difference)
        return _Field(values, change, size, marked, _least(values, size))

    @_stored
    def heights_of(hidden: torch.Tensor) -> torch.Tensor:
        return torch.stack([impulses.height(image) for image in known(hidden)])

    def pixels(hidden: torch.Tensor) -> _Field:
        images, heights = known(hidden), heights_of(hidden)
        soft = [~impulses.unresolved(i, h) for i, h in zip(images, heights, strict=True)]
        field = field_of(heights, 1, lambda new: new, difference)
        change = field.change.masked_fill(torch.stack(soft).any(0), torch.inf)
        return field._replace(change=change)

    yield pixels
    for axis in (-1, -2):

        def lines(hidden: torch.Tensor, axis: int = axis) -> _Field:
            means = _along(heights_of(hidden), axis)
            return field_of(means, 3, lambda new: _along(new.double(), axis) > 0)

        yield lines
    for axis in (-1, -2):

        def edges(hidden: torch.Tensor, axis: int = axis) -> _Field:
            steps = pad(known(hidden).diff(dim=axis), (0, 0) * (-1 - axis) + (0, 1))
            either = difference.minimum(difference.roll(-1, axis))
            # brightness changes over several pixels in smoke: a step two pixels away is of its sign
            # and at least half as large, as that across a thin structure is not
            wide = pad(steps.nan_to_num(0.0), (0, 0) * (-1 - axis) + (2, 2))
            two_away = (wide.narrow(axis, place, steps.shape[axis]) for place in (0, 4))
            soft = torch.stack([steps.square() < 2 * steps * other for other in two_away])
            soft = soft.flatten(0, 1).any(0)
            field = field_of(steps, 1, lambda new: new | new.roll(1, axis), either)
            return field._replace(change=field.change.masked_fill(soft, torch.inf))

        yield edges
    for size in _SIZES:

        def spots(hidden: torch.Tensor, size: int = size) -> _Field:
            return field_of(_spots(known(hidden), size), size, lambda new: _grown(new, size))

        yield spots


def _spots(pair: torch.Tensor, size: int) -> torch.Tensor:
    known = torch.stack([filled_in(image) for image in pair])
    return _means(known, size) - _means(known, 3 * size)


def _along(fields: torch.Tensor, axis: int) -> torch.Tensor:
    """Means over lines of 9 px."""
    rim = (0, 0) * (-1 - axis) + (_LINE // 2,) * 2
    return box_sum(pad(fields.nan_to_num(0.0), rim), _LINE, axis) / _LINE


def _candidates(detectors: Sequence[_Detector], hidden: torch.Tensor) -> torch.Tensor:
    """Pixels (z, y) of all that stands out alike of both images, at rest or not."""
    for detector in detectors:
        field = detector(hidden)
        alike = _beyond_chance(_alike(field, field.least), field)
        hidden = hidden | field.marked(alike)
    return _closed(hidden, _GAP)


def _still(
    detectors: Sequence[_Detector], structure: torch.Tensor, d: torch.Tensor
) -> torch.Tensor:
    """Pixels (z, y) at rest in air that moves by d: single ones, lines, edges, spots."""
    sharp = structure
    for detector in detectors:
        field = detector(structure)
        new = field.marked(_stays(field, d))
        if field.size == 1:
            sharp = sharp | new
        structure = structure | new
    return _with_sharp(_closed(structure, 1), sharp)


def _with_sharp(structure: torch.Tensor, sharp: torch.Tensor) -> torch.Tensor:
    """Areas that hold something sharp: lines and spots without any may be smoke in calm air."""
    if not bool(sharp.any()):
        return sharp
    areas = ndimage.binary_propagation(
        (sharp & structure).cpu().numpy(), np.ones((3, 3)), _grown(structure, 3).cpu().numpy()
    )
    return torch.as_tensor(areas, device=structure.device) & structure


def _least(values: torch.Tensor, size: int) -> torch.Tensor:
    """Height that no value (2, z, y) of a field exceeds by chance."""
    limit = impulses.threshold(values[0].numel() // size**2)
    return limit * torch.maximum(*(impulses.median_scale(i, size) for i in values))


def _stays(field: _Field, d: torch.Tensor) -> torch.Tensor:
    """Where what stands out of two fields (2, z, y) neither came along d nor goes on."""
    alike = _alike(field, field.least)
    if not bool(alike.any()):
        return alike
    one, two = field.pair.nan_to_num(0.0)
    both = [
        torch.where(_inside(along), (here - moved(there, along)).abs(), torch.inf)
        for here, there, along in ((one, two, d), (two, one, -d))
    ]
    off = torch.minimum(both[0], both[1])
    off = torch.where(off.isfinite(), off, 0.0)
    chance = impulses.median_scale(off, field.size)
    limit = impulses.threshold(off.numel() // field.size**2) * chance
    new = (off > limit) & alike & (field.change < _DIFFER * off) & (_lower(field.pair) > off / 2)
    if not bool(new.any()):
        return new
    new = _beyond_chance(new, field)
    if field.size > 1 or not bool(new.any()):
        return new
    # a structure is at rest as a whole: also where the air moves along it, which tells nothing,
    # and where it changes with the air that it dims; not where its motion is the better match
    stands_out = _alike(field, _WEAK * field.least) | (_lower(field.pair) > field.least)
    weak = stands_out & (field.change < off.maximum(chance))
    new = ndimage.binary_propagation(new.cpu(), np.ones((3, 3)), weak.cpu())
    return torch.as_tensor(new, device=weak.device)


def _beyond_chance(new: torch.Tensor, field: _Field) -> torch.Tensor:
    """Those pixels, or none if unrelated images have a third as many alike in one place.

    Among many bright particles some lie by chance where others were.
    """
    if not bool(new.any()):
        return new
    one, two = field.pair.nan_to_num(0.0)
    rows, columns = two.shape
    chance = []
    for i, j in impulses.THIRDS:
        other = two.roll((int(i * rows / 3), int(j * columns / 3)), (0, 1))
        rolled = field._replace(pair=torch.stack([one, other]), change=(other - one).abs())
        chance.append(int(_alike(rolled, field.least).sum()))
    # the median, as lines at rest fall on themselves
    return new & (int(new.sum()) >= _BEYOND_CHANCE * float(np.median(chance)))


def _closed(pixels: torch.Tensor, reach: int) -> torch.Tensor:
    """Pixels and gaps between them of up to twice the reach."""
    wide = _grown(pixels, 2 * reach + 1)
    return (
        ~_grown(pad(~wide, (reach,) * 4, value=False), 2 * reach + 1)[
            reach : reach + pixels.shape[0], reach : reach + pixels.shape[1]
        ]
        | pixels
    )


def _inside(d: torch.Tensor) -> torch.Tensor:
    """Pixels (z, y) from which d (2, z, y) leads to another one of the image."""
    inside = torch.ones_like(d[0], dtype=torch.bool)
    for axis, (part, n) in enumerate(zip(d, d.shape[1:], strict=True)):
        place = torch.arange(n).to(d).reshape(-1, *[1] * (1 - axis)) + part
        inside &= (place > -0.5) & (place < n - 0.5)
    return inside


def _alike(field: _Field, least: torch.Tensor) -> torch.Tensor:
    lower = _lower(field.pair)
    return (lower > least) & (field.change < _DIFFER * lower)


def _lower(pair: torch.Tensor) -> torch.Tensor:
    return pair.nan_to_num(0.0).abs().amin(0)


def _grown(pixels: torch.Tensor, size: int) -> torch.Tensor:
    pixels = pad(pixels.double(), (size // 2,) * 4)
    return box_sum(box_sum(pixels, size, -1), size, -2) > 0


def _means(images: torch.Tensor, size: int) -> torch.Tensor:
    images = pad(images, (size // 2,) * 4, "replicate")
    return box_sum(box_sum(images, size, -1), size, -2) / size**2


def _soft(image: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    image = working(image)
    return averaged(image, torch.isfinite(image) & known, _SOFT)


def _counted(pixels: torch.Tensor) -> str:
    """How many, and as a fraction of all where that is a tenth of a per cent or more."""
    number, fraction = int(pixels.sum()), float(pixels.double().mean())
    words = f"{number} pixel{'s' * (number > 1)}"
    return f"{words} ({100 * fraction:.2g} %)" if fraction >= 1e-3 else words
