"""Copies of an image in the other one, at rest: lag, afterglow, blended or denoised frames."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from scipy.stats import t as student

from lidar_mi.retrieval.correlation.motion import moved
from lidar_mi.retrieval.defects.faint_pattern import (
    in_blocks,
    inner,
    residual,
    standing,
    without_lines,
)
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows, working

FALSE_ALARM = 5e-3
"""Probability that images without a copy count as having one, which costs time: it is removed."""
# Fraction beyond which nothing is told of the other image, and fits until a copy is removed.
_LARGEST, _FITS = 0.6, 4
# Blurred air in a vortex pair gives up to 0.007 where there is next to no noise.
_LEAST = 0.01
# Side of the blocks of images and volumes, px, whose sums are nearly independent, their least
# number, the masked rim.
_BLOCK, _FEW_BLOCKS, _RIM = {2: 16, 3: 9}, 12, 4
# Relative error of a fraction by the orders left out: 0.2 is found as 0.194 to 0.197 in three pairs
# of texture of 2 px moved by 1.5 px.
_HIGHER_ORDERS = 0.03
# Of the fraction, by which displacements are too large if image 1 holds as much of the image
# before it: image 2 has the longer trail, which looks like three times the lag of displacements.
_EARLIER = 2 / 3
# Standard errors of the difference by which two estimates of one fraction may differ.
_UNLIKE = 2.0
# Robust standard deviations that a pixel's difference counts at most.
_CLIPPED = 4.0


class Copy(NamedTuple):
    """What of the difference of two images, warped to mid-time, is a copy at rest.

    fraction, stderr: of the other image's structure in image 2 (> 0) or in image 1 (< 0), after the
        flow has taken its part, and its standard error from the scatter over the images.
    degrees: of freedom of that.
    """

    fraction: float = 0.0
    stderr: float = 0.0
    degrees: int = 0

    @property
    def p_value(self) -> float:
        """Probability of a larger one without a copy."""
        if not self.stderr:
            return 1.0
        return float(2 * student.sf(abs(self.fraction) / self.stderr, self.degrees))

    @property
    def significant(self) -> bool:
        """Whether there is a copy, at the rate of false alarms."""
        return abs(self.fraction) > _LEAST and self.p_value < FALSE_ALARM

    def widened(self, displacement: Displacement) -> Displacement:
        """Displacements with the error of the fraction: each errs by as much of itself.

        And with that of what two images do not tell: whether only one of them holds a copy, or
        each holds a part of the image before it (afterglow), or what lies between: uniform.
        """
        if not self.fraction or displacement.covariance is None:
            return displacement
        variance = self.stderr**2 + (_EARLIER * self.fraction) ** 2 / 3
        error = variance * displacement.d[:, None] * displacement.d
        return displacement._replace(covariance=displacement.covariance + error)

    def __str__(self) -> str:
        if not self.significant:
            return ""
        one, other = (1, 2) if self.fraction > 0 else (2, 1)
        percent = f"{100 * abs(self.fraction):.1f} +- {100 * self.stderr:.1f} %"
        return f"{percent} of image {other} is image {one}, at rest"


def copy_at_rest(
    images: Sequence[torch.Tensor], displacement: Displacement, windows: Windows
) -> Copy:
    """The copy at rest in two images, from what the displacements between them do not explain.

    If image 2 is (1 - a) of its own air and a of image 1, a flow d is retrieved that is a d too
    slow. Warped to mid-time, with the mean m, the images then differ by

        a ((m(x + d) + m(x - d)) / 2 - m(x)),

    which is even in d, as no displacement is. It is the sum of a part that is of one sign
    along d and of the other across it, and of an isotropic part, which is also that of images of
    different blur. Both are regressed on, besides m, the difference by contrast. The
    coefficients have the covariance of the scores' scatter over blocks of 16 px, in volumes of 9 px
    (White 1980, Econometrica 48, 817-838). Where they differ by more than `_UNLIKE` standard
    errors, the directed one counts alone. To second order in d over the size of the structure.

    images (shape (z, y) or (x, z, y)): two.
    displacement: a field fitted to the images as a whole.
    """
    difference, mean, known, d = residual(images[:2], displacement, windows)
    dims = windows.dims
    inside = inner(known, _RIM)
    known = known & inside
    side = _BLOCK[dims]
    if math.prod(n // side for n in known.shape) < _FEW_BLOCKS or 2 * known.sum() < inside.sum():
        return Copy()
    limit = _CLIPPED * 1.4826 * difference[known].abs().median()
    mean = mean - mean[known].mean()
    along, *across = ((moved(mean, s) + moved(mean, -s)) / 2 for s in turned(d))
    sideways = sum(across)
    even = (((dims - 1) * along - sideways) / dims, (along + sideways - dims * mean) / dims, mean)
    fields = torch.stack([*map(without_lines, even), difference.clamp(-limit, limit)])
    blocks = working(in_blocks(fields * known, side).movedim(0, -1)).cpu()
    terms, observed = blocks[..., :3], blocks[..., 3:]
    number = len(blocks)
    gram = (terms.mT @ terms).sum(0)
    inverse = torch.linalg.pinv(gram, hermitian=True)
    coefficients = inverse @ (terms.mT @ observed).sum(0)
    scores = (terms.mT @ (observed - terms @ coefficients))[..., 0]
    covariance = inverse @ (scores.mT @ scores) @ inverse * number / (number - 3)
    value, covariance = coefficients[:2, 0], covariance[:2, :2]
    weight = torch.tensor([1.0, 0.0]).to(value)
    apart = covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]
    if (value[0] - value[1]).square() < _UNLIKE**2 * apart:
        part = ((covariance[0, 0] - covariance[0, 1]) / apart).clamp(0.0, 1.0)
        weight = torch.stack([1 - part, part])
    stderr = (weight @ covariance @ weight).sqrt()
    if not 0 < stderr < _LARGEST:  # slow air tells nothing
        return Copy()
    return Copy(float(weight @ value), float(stderr), number - 3)


def turned(d: torch.Tensor) -> list[torch.Tensor]:
    """Vectors (2, z, y) or (3, x, z, y), and those of their length at right angles to them."""
    if len(d) == 2:
        return [d, torch.stack([-d[1], d[0]])]
    # from the axis that is least along them
    axis = torch.eye(3).to(d)[d.abs().flatten(1).mean(1).argmin()].reshape(3, 1, 1, 1).expand_as(d)
    length = d.norm(dim=0).clamp(min=1e-9)
    one = torch.linalg.cross(d, axis, dim=0)
    one = one * length / one.norm(dim=0).clamp(min=1e-9)
    return [d, one, torch.linalg.cross(d / length, one, dim=0)]


def without_copy(
    estimate: Callable[..., Displacement],
    displacement: Displacement,
    images: Sequence[torch.Tensor],
    windows: Windows,
    field: Callable[[Displacement], Displacement],
) -> tuple[Displacement, Copy, Sequence[torch.Tensor]]:
    """A field from images without the copy at rest of one in the other.

    A copy of fraction a is subtracted and the fit repeated, until none is left.

    estimate: from two images to the field.
    displacement: of the images as they are.
    images (shape (z, y) or (x, z, y)): two.
    field: from vectors to those by which images are warped.

    Returns
    -------
    displacement : Displacement
        As it was if there is no copy, or if what is left is none. Without the error of the copy.
    copy : Copy
    images : sequence of torch.Tensor
        Without the copy.
    """
    copy = copy_at_rest(images, field(displacement), windows)
    if not copy.significant:
        return displacement, Copy(), images
    total, part = 0.0, copy
    for _ in range(_FITS):
        step = max(-0.5, min(0.5, part.fraction))
        total += step * (1 - abs(total))
        if abs(total) > _LARGEST:
            break
        clean = _subtracted(images, total)
        again = estimate(*clean)
        part = copy_at_rest(clean, field(again), windows)
        if abs(part.fraction) > 0.5 * part.stderr:
            continue
        if not part.stderr or standing(clean, field(again), windows).fraction:
            break
        stderr = math.hypot(part.stderr * (1 - abs(total)), _HIGHER_ORDERS * total)
        return again, Copy(total, stderr, part.degrees), clean
    return displacement, copy, images


def _subtracted(images: Sequence[torch.Tensor], fraction: float) -> list[torch.Tensor]:
    """Images without a fraction of the other one: of image 1 in 2, or if negative of 2 in 1."""
    first, second = map(working, images)
    if fraction < 0:
        return [(first + fraction * second) / (1 + fraction), second]
    return [first, (second - fraction * first) / (1 - fraction)]
