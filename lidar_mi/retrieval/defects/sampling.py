"""How pixels came about: copies, areas without a picture, repeated, alternating, interpolated.

A retrieval assumes that each pixel of each image is a sample of its own of the air at one time. A
structure of the sampling is at rest, and draws displacements to whole periods of it.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from scipy.stats import f as fisher

from lidar_mi.retrieval.images.quality import nan_at

FALSE_ALARM = 1e-4
"""Probability that images of independent samples count as structured, of each test."""
LARGEST_PERIOD = 32
"""Px."""
# Side of the tiles, px, in which the chance of equal values is estimated.
_TILE = 24
# Least side of a copied area, px, by the dimensions: without noise smaller ones are equal by chance
# where the air hardly moves.
_LEAST_SIDE = {2: 6, 3: 3}
# Fraction of the pixels around an area that change by one step or less where the air calms down.
_CALM = 0.8
# Least side of a constant area that counts as without a picture, px.
_BLANK = 5
# Step across its rim over what a tenth of the differences of neighbours in the picture exceed.
_STEP = 1.5
# Fraction of the lines that repeat the one before from which all are said to be repeated.
_MANY = 0.25
# Fraction of the neighbours in a tile that are equal, from which nearest neighbours matter.
_GRIDDED = 0.1
# Fraction of the pixels by which an image is spoilt.
_MOST = 0.5
# Lines over which the local energy is averaged, and times that which a value counts at most.
_AROUND, _CLIPPED = 8.0, 4.0
# Ordinates to each side whose mean is the level of a periodogram, and those left out by the window.
_ORDINATES, _LEAKED = 10, 2
# Longest period, px, of which lines of one kind resolve the air.
_THINNED = 4
# Mean square of second differences between samples over that at them: 0 but for rounding where
# lines are interpolated linearly, 1 where all are alike. Half-way.
_BETWEEN = 0.5


class Sampling(NamedTuple):
    """Structure of the sampling of two or more images.

    hidden (images, ...): pixels that show no air, or that of another image.
    spoilt: nothing tells the air from the sampling.
    steps, first: along each axis, so many pixels are one sample, or one of each kind; the first of
        them.
    middle: from its first pixel to the place of a sample, px.
    said: by name, with the period; empty: none.
    """

    hidden: torch.Tensor
    spoilt: bool
    steps: tuple[int, ...]
    first: tuple[int, ...]
    middle: tuple[float, ...]
    said: str

    @property
    def thinned(self) -> bool:
        """Whether there are fewer samples than pixels."""
        return max(self.steps) > 1

    def masked(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The images with NaN in place of hidden pixels."""
        return [nan_at(*pair) for pair in zip(images, self.hidden, strict=True)]


def no_structure(images: Sequence[torch.Tensor]) -> Sampling:
    """Of images that are known to be of independent samples."""
    none = torch.zeros((len(images), *images[0].shape), dtype=torch.bool, device=images[0].device)
    dims = images[0].ndim
    return Sampling(none, False, (1,) * dims, (0,) * dims, (0.0,) * dims, "")


def sampling(images: Sequence[torch.Tensor], false_alarm: float = FALSE_ALARM) -> Sampling:
    """Structure of the sampling of images or volumes.

    - *Copies*: cubes of values that are equal to the bit in successive images. Their side s is such
      that N p^(s^dims) is below the rate of false alarms, with N pixels and the chance p that
      two values are equal. Differences of a log-concave distribution, in steps of the values'
      resolution, have p_0 <= p_1^2 / p_2 (Keilson & Gerber 1971, J. Am. Stat. Assoc. 66, 386), so
      that p follows from the differences that are not zero, in tiles of 24 px.
    - *No picture*: constant areas of an image that end in a step, of more than one level and 1.5
      times what a tenth of the differences of neighbours exceed. Neither noise nor a lens or beam
      makes one.
    - *Repeated*: lines that are equal to the next one to the bit; or tiles in which more neighbours
      are equal than p allows (gates on a grid by nearest neighbours). Smooth air in whole numbers
      has equal neighbours where it changes by less than one level per pixel: next to them are
      differences of one level. Where those are the majority, neighbours and single lines that are
      equal do not count.
    - *Periodic*: statistics of lines (`_statistics`) have a period of up to 32 px with the same
      phase in all images: interpolated (Gallagher 2005, Proc. Canadian Conf. Computer and Robot
      Vision, 65-72), interlaced, mosaics, blocks of a codec. Without one an ordinate of the
      periodogram over the mean of its neighbours has an F distribution (Fisher 1929, Proc. R. Soc.
      Lond. A 125, 54-59). Lines of one kind are used alone where the period is 2, or 3 or 4
      and lines between them are interpolated linearly.

    Areas at an image's largest value are left to the test of saturation.

    images (shape (z, y) or (x, z, y))
    """
    values = [image.detach().cpu().numpy() for image in images]
    names = "xzy"[-values[0].ndim :]
    steps, first, middle = [1] * len(names), [0] * len(names), [0.0] * len(names)
    hidden = np.zeros((len(values), *values[0].shape), bool)
    spoilt, said = False, []
    for axis, name in enumerate(names):
        repeats = np.logical_and.reduce([_repeats(v, axis) for v in values])
        if repeats.mean() <= _MANY:
            coarse = np.logical_or.reduce([_coarse(v, axis) for v in values])
            lines = 1 + np.flatnonzero(repeats & ~coarse)
            hidden[(slice(None),) * (1 + axis) + (lines,)] = True
            said += [f"{len(lines)} lines repeat the one before along {name}"] * bool(len(lines))
            continue
        starts = np.flatnonzero(~np.r_[False, repeats])
        lengths = np.diff(np.r_[starts, len(repeats) + 1])
        period = lengths[1:-1].mean() if len(lengths) > 2 else len(repeats)
        said.append(f"pixels are repeated every {period:.2g} px along {name}")
        if len(lengths) > 2 and max(lengths) == min(lengths[1:-1]):
            steps[axis], middle[axis] = int(max(lengths)), (max(lengths) - 1) / 2
            first[axis] = int(starts[0] if lengths[0] == steps[axis] else starts[1])
        else:
            spoilt = True
    ranks = _ranks(values) if max(steps) == 1 and not spoilt else []
    if ranks:
        no_air, remarks = _hidden(values, ranks, false_alarm)
        hidden |= no_air
        said += remarks
        known = [np.where(h, np.nan, v) for v, h in zip(values, hidden, strict=True)]
        for axis, name in enumerate(names):
            period, start = _period(known, axis, false_alarm)
            if not period:
                continue
            said.append(f"a period of {period:.3g} px along {name}")
            if start is None:
                spoilt = True
            else:
                steps[axis], first[axis] = round(period), start
    if max(steps) == 1 and not spoilt:
        gridded = np.all([_gridded(r, ~h) for r, h in zip(ranks, hidden, strict=True)], 0)
        if gridded.any():
            said.append(f"neighbours are equal on {gridded.mean():.2g} of the pixels")
        hidden |= gridded
        spoilt = bool(gridded.mean() > _MOST)
    masks = torch.as_tensor(hidden, device=images[0].device)
    return Sampling(masks, spoilt, tuple(steps), tuple(first), tuple(middle), ", ".join(said))


def _hidden(
    values: Sequence[np.ndarray], ranks: Sequence[np.ndarray], false_alarm: float
) -> tuple[np.ndarray, list[str]]:
    """Pixels of each image without a picture or copied, and what to say of them."""
    blank = np.stack([_without_picture(v) for v in values])
    said = [f"no picture on {blank.mean():.2g} of the pixels"] * bool(blank.any())
    hidden = blank.copy()
    for n, (one, other) in enumerate(pairwise(ranks), 1):
        copied = _copied(one, other, false_alarm) & ~blank[n - 1 : n + 1].any(0)
        if copied.any() and not copied.all():
            hidden[n - 1 : n + 1] |= copied
            said.append(f"{copied.mean():.2g} of image {n + 1} is copied from image {n}")
    return hidden, said


def _ranks(values: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Values by their number among all; -1 at the ends of an image's range or if not finite."""
    known = [np.asarray(np.isfinite(v)) for v in values]
    together = np.concatenate([v[k] for v, k in zip(values, known, strict=True)])
    _, numbers = np.unique(together, return_inverse=True)
    ends = np.cumsum([k.sum() for k in known])
    ranks = []
    for k, number in zip(known, np.split(numbers, ends[:-1]), strict=True):
        rank = np.full(k.shape, -1)
        inside = (number > number.min(initial=0)) & (number < number.max(initial=0))
        rank[k] = np.where(inside, number, -1)
        ranks.append(rank)
    return ranks


def _chance(steps: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The largest chance that differences of ranks are 0, from the others, by tiles."""
    size = [min(_TILE, n) for n in steps.shape]
    one, two, number = (
        ndimage.uniform_filter((known & part).astype(float), size) * np.prod(size)
        for part in (np.abs(steps) == 1, np.abs(steps) == 2, np.ones_like(known))
    )
    # of one sign each; half a count for what was not seen
    return ((one / 2 + 0.5) ** 2 / (two / 2 + 0.5) / np.maximum(number, 1)).clip(1e-12, 1 - 1e-12)


def _copied(one: np.ndarray, other: np.ndarray, false_alarm: float) -> np.ndarray:
    """Cubes of equal pixels that are larger than chance allows, and not constant."""
    known = (one >= 0) & (other >= 0)
    same = known & (one == other)
    copied = np.zeros_like(same)
    if not same.any():
        return copied
    cells = np.log(same.size / false_alarm) / -np.log(_chance(other - one, known))
    side = np.maximum(np.ceil(cells ** (1 / same.ndim)), _LEAST_SIDE[same.ndim])
    for size in np.unique(side[same & (side <= min(_TILE, *same.shape))]).astype(int):
        copied |= _opened(same, size) & (side <= size)
    copied &= ~_opened(_constant(one), 3)
    # air that calms down without noise changes by a step or less around
    label, number = ndimage.label(copied)
    if not number:
        return copied
    ring = np.where(copied | ~known, 0, ndimage.grey_dilation(label, 5))
    index = np.unique(ring)
    calm = np.zeros(number + 1)
    calm[index] = ndimage.mean(np.abs(other - one) <= 1, ring, index)
    calm[0] = 0.0
    return copied & ~(calm > _CALM)[label]


def _opened(pixels: np.ndarray, size: int) -> np.ndarray:
    """Cubes of this side that all are."""
    return ndimage.grey_opening(pixels.astype(np.uint8), size=(size,) * pixels.ndim) > 0


def _constant(values: np.ndarray) -> np.ndarray:
    """Pixels that all around them equal."""
    values = np.where(np.isfinite(values), values, -np.inf)
    return ndimage.maximum_filter(values, 3) == ndimage.minimum_filter(values, 3)


def _without_picture(values: np.ndarray) -> np.ndarray:
    """Constant areas that end in a step, and their rim."""
    none = np.zeros(values.shape, bool)
    finite = np.isfinite(values)
    # areas at the largest value are saturated
    inside = finite & (values < values[finite].max(initial=-np.inf))
    core = ndimage.grey_opening((_constant(values) & inside).astype(np.uint8), _BLANK - 2) > 0
    if not core.any():
        return none
    cube = np.ones((3,) * values.ndim)
    # pixels around a core have its value, so that areas of different values do not mix
    label, number = ndimage.label(core)
    label = np.where(finite, ndimage.grey_dilation(label, 3), 0)
    known = np.where(label == 0, values, np.nan)
    differences = [np.abs(np.diff(known, axis=axis)).ravel() for axis in range(values.ndim)]
    typical = (
        np.nanquantile(np.concatenate(differences), 0.9) if np.isfinite(known).any() else np.inf
    )
    wide = ndimage.grey_dilation(label, 3)
    rim = (wide > 0) & (label == 0) & finite
    level = np.r_[0.0, ndimage.maximum(values, label, np.arange(1, number + 1))][wide]
    levels = np.unique(values[finite])
    off = np.abs(values - level)
    levels_off = np.abs(np.searchsorted(levels, values) - np.searchsorted(levels, level))
    index = np.unique(wide[rim])
    step, steps = np.zeros((2, number + 1))
    if len(index):
        step[index] = ndimage.median(off, np.where(rim, wide, 0), index)
        steps[index] = ndimage.median(levels_off, np.where(rim, wide, 0), index)
    blank = ((step > _STEP * typical) & (steps > 1))[label] & (label > 0)
    for one in np.unique(values[blank]):
        blank |= ndimage.binary_propagation(blank & (values == one), mask=values == one)
    return ndimage.binary_dilation(blank, cube)


def _repeats(values: np.ndarray, axis: int) -> np.ndarray:
    """Which lines equal the next one to the bit, and are not constant."""
    lines = np.moveaxis(values, axis, 0).reshape(values.shape[axis], -1)
    known = np.isfinite(lines).all(1)
    same = (lines[1:] == lines[:-1]).all(1) & known[1:]
    return same & (np.ptp(np.where(np.isfinite(lines[1:]), lines[1:], 0.0), 1) > 0)


def _coarse(values: np.ndarray, axis: int) -> np.ndarray:
    """Which lines and the next one lie between others that differ by one level or less.

    Smooth air in whole numbers repeats lines by chance.
    """
    levels = np.unique(values, return_inverse=True)[1].reshape(values.shape)
    lines = np.moveaxis(levels, axis, 0).reshape(values.shape[axis], -1)
    steps = np.abs(np.diff(lines, axis=0))
    above = np.pad(steps, ((1, 1), (0, 0)))
    beside = np.concatenate([above[:-2], above[2:]], 1)
    return (beside > 1).sum(1) <= (beside == 1).sum(1)


def _statistics(lines: np.ndarray) -> list[np.ndarray]:
    """Means over the places of lines (line, place), NaN where not known, of what sampling changes.

    Energy of second differences (interpolation) and of first ones (fields displaced across the
    lines); product of the gradient along a line with the next line (fields displaced along the
    lines: opposite from even to odd lines and from odd to even); value, and value of alternating
    places (mosaics).
    """
    above, line, below = lines[:-2], lines[1:-1], lines[2:]
    signs = np.where(np.arange(lines.shape[1]) % 2, -1.0, 1.0)
    around = ndimage.uniform_filter1d(np.nan_to_num(lines), 5, axis=0)[1:-1]
    gradient = np.zeros_like(line)
    gradient[:, 1:-1] = line[:, 2:] - line[:, :-2]
    fields = [
        (above - 2 * line + below) ** 2,
        (line - below) ** 2,
        gradient * (below - around),
        line - around,
        signs * (line - around),
    ]
    means = []
    for field in fields:
        known = np.isfinite(field)
        number = known.sum(1)
        field = np.where(known, field, 0.0)
        level = ndimage.gaussian_filter1d(np.abs(field).sum(1), _AROUND)
        level /= np.maximum(ndimage.gaussian_filter1d(number.astype(float), _AROUND), 1e-9)
        level = np.maximum(level, 1e-300)[:, None]
        field = np.clip(field / level, -_CLIPPED, _CLIPPED)
        means.append(field.sum(1) / np.maximum(number, 1))
    return means


def _period(
    images: Sequence[np.ndarray], axis: int, false_alarm: float
) -> tuple[float, int | None]:
    """The longest period of the lines' statistics, px, 0 without one; and the first sample.

    None: the lines of no kind are samples that resolve the air. Of longer periods than fields and
    mosaics have, two lines, they are where lines between them are interpolated linearly.

    All that is periodic must be at rest: a lattice in the air is not.
    """
    lines = [np.moveaxis(v, axis, 0).reshape(v.shape[axis], -1) for v in images[:2]]
    size = len(lines[0]) - 2
    if size < LARGEST_PERIOD:
        return 0.0, None
    frequency = np.fft.rfftfreq(size)
    use = frequency >= 1 / LARGEST_PERIOD
    limit = false_alarm / use.sum() / 5 / images[0].ndim
    window = np.hanning(size + 2)[1:-1]
    periods = []
    for number, pair in enumerate(zip(*map(_statistics, lines), strict=True)):
        one, two = (np.fft.rfft((p - p.mean()) * window) for p in pair)
        ratios = [np.abs(part) ** 2 / _level(np.abs(part) ** 2) for part in (one, two)]
        ratio = np.minimum(*ratios)
        # the ordinate of period 2 is real
        degrees = np.where(frequency > 0.5 - 1 / size, 1, 2)
        # waves in the air have other periods than two lines, and the mean values as well
        strong = (use if number < 3 else degrees == 1) & (
            fisher.sf(ratio, degrees, 2 * _ORDINATES) < limit
        )
        if not strong.any():
            continue
        off = np.abs(np.angle(one * np.conj(two)))
        if (off[strong] > np.maximum(3 / np.sqrt(ratio[strong]), 0.1)).any():
            return 0.0, None
        # the window spreads a peak over its neighbours
        peak = strong & (ratio == ndimage.maximum_filter1d(ratio, 2 * _LEAKED + 1))
        if peak.any():
            best = np.flatnonzero(peak)[0]
            periods.append((1 / _refined(one, best, size), pair[0] if number == 0 else None))
    if not periods:
        return 0.0, None
    period, energy = max(periods, key=lambda entry: entry[0])
    whole = round(period)
    if abs(period - whole) > 0.02 * whole or whole > _THINNED:
        return period, None
    if energy is None:
        return period, 0 if whole == 2 else None
    # between samples that are interpolated linearly there is no second difference; two lines of
    # each block of a codec have one
    means = [np.mean(energy[start::whole]) for start in range(whole)]
    if whole > 2 and sorted(means)[-2] > _BETWEEN * max(means):
        return period, None
    return period, (int(np.argmax(means)) + 1) % whole


def _level(power: np.ndarray) -> np.ndarray:
    """Of a periodogram about each ordinate: the larger of the means to both sides.

    The one to the left next to the end: a periodogram that goes on beyond it, mirrored, would
    repeat a peak there.
    """
    reach = _ORDINATES + _LEAKED
    wide = np.pad(power, (reach, 0), mode="reflect")
    sums = np.cumsum(np.r_[0.0, wide])
    at = np.arange(len(power)) + reach
    left = sums[at - _LEAKED] - sums[at - reach]
    right = np.zeros_like(left)
    right[:-reach] = sums[2 * reach + 1 :] - sums[reach + _LEAKED + 1 : -_ORDINATES]
    return np.maximum(np.maximum(left, right) / _ORDINATES, 1e-300)


def _refined(spectrum: np.ndarray, best: int, size: int) -> float:
    """Frequency of a peak of a Hann window, 1/px, from its neighbours."""
    if best + 1 >= len(spectrum):
        return best / size
    before, here, after = np.abs(spectrum[best - 1 : best + 2])
    side, ratio = (1, after / here) if after > before else (-1, before / here)
    return (best + side * (2 * ratio - 1) / (1 + ratio)) / size


def _gridded(rank: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Tiles in which more neighbours are equal than chance allows, in images that vary."""
    known = known & (rank >= 0) & ~_opened(_constant(rank), _BLANK)
    size = [min(_TILE, n) for n in rank.shape]
    gridded = np.zeros_like(known)
    for axis in range(rank.ndim):
        steps = np.diff(rank, axis=axis, append=-1)
        both = known & np.roll(known, -1, axis)
        number = np.maximum(ndimage.uniform_filter(both.astype(float), size), 1e-9)
        equal = ndimage.uniform_filter((both & (steps == 0)).astype(float), size) / number
        chance = _chance(steps, both)
        scatter = np.sqrt(chance / (number * np.prod(size)))
        beside = both & (steps != 0)
        pairs = both & (steps == 0)
        beside &= np.roll(pairs, 1, axis) | np.roll(pairs, -1, axis)
        more, single = (
            ndimage.uniform_filter((beside & part).astype(float), size)
            for part in (np.abs(steps) > 1, np.abs(steps) == 1)
        )
        excess = (equal > _GRIDDED) & (equal > 2 * chance + 5 * scatter) & (number > 0.25)
        gridded |= excess & (more > 2 * single)
    return gridded
