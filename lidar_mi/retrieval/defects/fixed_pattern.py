"""Gains of a detector's columns, rows and pixels: a pattern that all images have at one place."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.ndimage import map_coordinates
from scipy.stats import norm
from scipy.stats import t as student
from torch.nn.functional import pad

from lidar_mi.retrieval.correlation.first_pass import coarse_windows
from lidar_mi.retrieval.correlation.motion import motion_around, moved
from lidar_mi.retrieval.defects.faint_pattern import in_blocks, inner
from lidar_mi.retrieval.images.windows import Windows, averaged, box_sum, working

FALSE_ALARM = 1e-4
"""Probability that columns, rows or pixels of images without a pattern count as one."""
# Px; width of the Gaussian over which the local brightness is averaged.
_LOCAL = 4.0
# Neighbours to each side whose mean is subtracted from a profile.
_NEIGHBOURS = 2
# Robust standard deviations that values count at most: of profiles, differences, pixels.
_CLIPPED = 2.5, 3.0, 4.0
# Correlation of neighbours in a profile: that of independent gains is -0.3, of texture positive.
_SMOOTH = 0.2
# Iterations over motion and gains.
_ITERATIONS = 2
# Px; where the air moves by less, the pattern of pixels cannot be separated from texture.
_LEAST_DISPLACEMENT = 1.5
# Side of the blocks, px, whose means are independent; the rim that is masked.
_BLOCK, _RIM = 16, 8
# Fewer blocks say too little of their scatter.
_FEW_BLOCKS = 5
# Correlation at rest of what the motion leaves: noise-free texture of 2 px leaves up to 0.16.
_LEAST = 0.25
# Of the local contrast, from which gains of pixels make errors larger than stated.
_SPOILS = 0.2
# The same of residual lines: that are detected, or that the error of their estimate allows.
_LEFT = 0.1, 0.16


class FixedPattern(NamedTuple):
    """What is at rest all over the images.

    gain (shape broadcast to (z, y)): of columns and rows, 1 where there is none.
    columns, rows, pixels: standard deviation of the gains; 0 where no pattern was detected.
    spoils: what is not removed is strong enough to make errors larger than stated.
    """

    gain: torch.Tensor
    columns: float = 0.0
    rows: float = 0.0
    pixels: float = 0.0
    spoils: bool = False

    def removed(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The images without the gains of columns and rows."""
        if not self.columns and not self.rows:
            return list(images)
        return [working(image) / self.gain for image in images]

    def with_pixels(
        self, images: Sequence[torch.Tensor], d: torch.Tensor, false_alarm: float = FALSE_ALARM
    ) -> "FixedPattern":
        """The pattern with that of the pixels of images from which this one is `removed`.

        images (z, y): the first two of them count.
        d (2, z, y): the motion, px.
        """
        relative = [_relative(image) for image in images[:2]]
        pixels = _pixels(relative, d, false_alarm)
        spoils = pixels**2 > _SPOILS**2 * (_contrast(relative) - pixels**2)
        return self._replace(pixels=pixels, spoils=self.spoils or spoils)

    def __str__(self) -> str:
        named = {"columns": self.columns, "rows": self.rows, "pixels": self.pixels}
        said = ", ".join(f"{name} {value:.1%}" for name, value in named.items() if value)
        return f"gains differ: {said}" if said else ""


def fixed_pattern(
    images: Sequence[torch.Tensor], windows: Windows, false_alarm: float = FALSE_ALARM
) -> FixedPattern:
    """Gains of columns and rows that two images have in common.

    The profile is the mean of the relative image (over the local mean, less 1) along columns, less
    the mean of 5 neighbours. Those of the upper 40 % of one image and of the lower 40 % of the
    other hold different air. They correlate by chance with the variance of Bartlett (1946, J. R.
    Stat. Soc. Suppl. 8, 27-41), which allows for their autocorrelations. Both pairs must exceed
    what this allows at the rate of false alarms, the correlation of the images' profiles must be
    highest at no lag, and neighbours must not be alike. Rows as columns.

    The gains p follow from what the motion d does not explain,
    r1(x) - r2(x + d) = p(y) - p(y + d_y), by least squares with a prior variance, the covariance
    of the profiles. Motion and gains are estimated iteratively. Gains that are alike over more
    than the local mean are not found.

    images (z, y): the first two of them count.
    """
    images = images[:2]
    relative = [_relative(image) for image in images]
    profiles = {axis: _lines(_turned(relative, axis), false_alarm) for axis in (1, 0)}
    prior = {axis: variance for axis, (variance, _) in profiles.items() if variance}
    if not prior:
        return FixedPattern(_gain({}, images[0]))
    gains = {axis: profiles[axis][1] for axis in prior}
    unknown = {}
    for _ in range(_ITERATIONS):
        now = [working(image) / _gain(gains, image) for image in images]
        d = motion_around(now[0], now[1], coarse_windows(windows))[0].cpu().numpy()
        for axis in prior:
            others = _gain({other: p for other, p in gains.items() if other != axis}, now[0])
            values = [_relative(working(image) / others) for image in images]
            gains[axis], unknown[axis] = _solved(values, d, axis, prior[axis])
    gain = _gain(gains, images[0])
    relative = [_relative(working(image) / gain) for image in images]
    left = max(_lines(_turned(relative, axis), false_alarm)[0] for axis in prior)
    columns, rows = (float(gains[axis].std()) if axis in gains else 0.0 for axis in (1, 0))
    detected, undetermined = (limit**2 * _contrast(relative) for limit in _LEFT)
    spoils = bool(left > detected or max(unknown.values()) > undetermined)
    return FixedPattern(gain, columns, rows, spoils=spoils)


def _turned(relative: Sequence[np.ndarray], axis: int) -> list[np.ndarray]:
    return [r if axis else r.T for r in relative]


def _contrast(relative: Sequence[np.ndarray]) -> float:
    """Variance of the relative images."""
    return float(np.mean([np.mean(r**2) for r in relative]))


def _relative(image: torch.Tensor) -> np.ndarray:
    """The image over its local mean, less 1; 0 where it is not finite or dark."""
    image = working(image)
    finite = torch.isfinite(image)
    mean = averaged(image, finite, _LOCAL)
    known = finite & (mean > 0)
    return torch.where(known, image / torch.where(known, mean, 1.0) - 1, 0.0).cpu().numpy()


def _gain(gains: dict[int, np.ndarray], image: torch.Tensor) -> torch.Tensor:
    gain = torch.ones_like(working(image[:1, :1]))
    for axis, p in gains.items():
        along = torch.as_tensor(p).to(gain).clamp(min=-0.8)
        gain = gain * (1 + (along[None] if axis else along[:, None]))
    return gain


def _profile(relative: np.ndarray) -> np.ndarray:
    mean = relative.mean(0)
    width = 2 * _NEIGHBOURS + 1
    around = np.convolve(np.pad(mean, _NEIGHBOURS, mode="edge"), np.ones(width) / width, "valid")
    profile = mean - around
    limit = _CLIPPED[0] * 1.4826 * np.median(np.abs(profile))
    profile = np.clip(profile, -limit, limit)
    return profile - profile.mean()


def _lines(relative: Sequence[np.ndarray], false_alarm: float) -> tuple[float, np.ndarray]:
    """Variance of the gains of columns, 0 without a pattern, and their profile."""
    size = len(relative[0])
    part = int(0.4 * size)
    one, two = (_profile(r) for r in relative)
    profile = (one + two) / 2
    products = []
    for upper, lower in (relative, relative[::-1]):
        a, b = _profile(upper[:part]), _profile(lower[size - part :])
        scale = a.std() * b.std()
        if not scale:
            return 0.0, profile
        lags = len(a) // 8
        bartlett = 1 + 2 * np.sum(_autocorrelation(a, lags) * _autocorrelation(b, lags))
        chance = scale * np.sqrt(max(bartlett, 1.0) / len(a))
        products.append((a * b).mean())
        if products[-1] < norm.isf(false_alarm) * chance:
            return 0.0, profile
    reach = min(8, len(one) // 4)
    lagged = [
        np.mean(one[reach:-reach] * np.roll(two, k)[reach:-reach]) for k in range(-reach, reach + 1)
    ]
    if np.argmax(lagged) != reach or _autocorrelation(profile, 1)[0] > _SMOOTH:
        return 0.0, profile
    # less the mean of 5, independent values keep 4 / 5 of their variance
    return float(np.mean(products)) / (1 - 1 / (2 * _NEIGHBOURS + 1)), profile


def _autocorrelation(profile: np.ndarray, lags: int) -> np.ndarray:
    square = np.sum(profile**2)
    return np.array([np.sum(profile[k:] * profile[:-k]) / square for k in range(1, lags + 1)])


def _solved(
    relative: Sequence[np.ndarray], d: np.ndarray, axis: int, prior: float
) -> tuple[np.ndarray, float]:
    """Gains of columns (axis 1) or rows (0) from what the motion d does not explain.

    And the mean of their variances: near the prior one where the air hardly moves across the lines.
    """
    one, two = relative
    here = np.indices(one.shape)
    there = here + d
    last = np.reshape(one.shape, (2, 1, 1)) - 1
    inside = ((there >= 0) & (there <= last)).all(0)
    off = (one - map_coordinates(two, there, order=3, mode="nearest"))[inside]
    limit = _CLIPPED[1] * 1.4826 * np.median(np.abs(off))
    off = np.clip(off, -limit, limit)
    here, there, size = here[axis][inside], there[axis][inside], one.shape[axis]
    low = np.minimum(there.astype(int), size - 2)
    part = there - low
    number = np.arange(off.size)
    values = np.concatenate([np.ones_like(part), part - 1, -part])
    place = np.tile(number, 3), np.concatenate([here, low, low + 1])
    matrix = sparse.csr_matrix((values, place), shape=(off.size, size))
    normal, right, residual = (matrix.T @ matrix).toarray(), matrix.T @ off, off
    for _ in range(2):
        # what the gains do not explain; neighbours, over a correlation length of 2 px, share it
        weight = 4 * np.mean(residual**2) / prior
        inverse = np.linalg.inv(normal + weight * np.eye(size))
        gains = inverse @ right
        residual = off - matrix @ gains
    return gains - gains.mean(), prior * weight * float(np.trace(inverse)) / size


def _pixels(relative: Sequence[np.ndarray], d: torch.Tensor, false_alarm: float) -> float:
    """Standard deviation of the gains of pixels; 0 without a pattern.

    What the motion leaves of image 1 and, backward, of image 2 is r1, r2. Its covariance at rest,
    less that with the four neighbours, is the variance of the gains. Student's t of its means over
    blocks of 16 px where the air moves by 1.5 px or more must exceed what the rate of false alarms
    allows, and the correlation 0.25. The gains are not removed: an estimate from two images takes
    up errors of the motion, and draws vectors to that motion.
    """
    known = d.square().sum(0) >= _LEAST_DISPLACEMENT**2
    known &= inner(known, _RIM)
    if not bool(known.any()):
        return 0.0
    one, two = (torch.as_tensor(r).to(d) for r in relative)
    one, two = (_clipped(_sharp(r), known) for r in (one - moved(two, d), two - moved(one, -d)))
    around = (two.roll(1, 0) + two.roll(-1, 0) + two.roll(1, 1) + two.roll(-1, 1)) / 4
    sums = torch.stack([one * (two - around) * known, one**2 * known, two**2 * known, known.to(d)])
    sums = in_blocks(sums, _BLOCK).sum(-1)
    sums = sums[:, sums[3] > _BLOCK**2 / 2]
    number = sums.shape[1]
    if number < _FEW_BLOCKS:
        return 0.0
    excess, square1, square2 = (sums[:3] / sums[3]).cpu().numpy()
    mean, least = excess.mean(), student.isf(false_alarm, number - 1) / np.sqrt(number)
    correlation = mean / max(np.sqrt(square1.mean() * square2.mean()), 1e-30)
    if mean <= least * excess.std(ddof=1) or correlation <= _LEAST:
        return 0.0
    return float(np.sqrt(mean))


def _sharp(image: torch.Tensor) -> torch.Tensor:
    around = pad(image[None], (1,) * 4, "replicate")[0]
    return image - box_sum(box_sum(around, 3, -1), 3, -2) / 9


def _clipped(image: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    limit = _CLIPPED[2] * 1.4826 * float(image[known].abs().median())
    return image.clamp(-limit, limit)
