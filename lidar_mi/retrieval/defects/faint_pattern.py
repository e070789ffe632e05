"""A faint pattern at rest all over the images: the fraction of a displacement that it takes."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.stats import t as student

from lidar_mi.retrieval.correlation.motion import moved
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows, linear_weights, separable, working

FALSE_ALARM = 1e-3
"""Probability that images without a pattern count as having one."""
# Side of the blocks, px, whose sums are nearly independent, their least number, the masked rim.
_BLOCK, _FEW_BLOCKS, _RIM = 24, 8, 12
# Px; slower air shows nothing.
_SLOWEST = 0.25
# Robust standard deviations that a pixel's difference counts at most.
_CLIPPED = 4.0
# Noise-free smoke that moves in its plane alone gives up to 0.009.
_LEAST = 0.015
# Above, the bias is no longer proportional to the fraction.
_LARGEST = 0.08
# Relative uncertainty of the bias along and across the wind: a pattern need not have the
# texture's spectrum, and its gradients at one place are not isotropic.
_UNLIKE = 0.4


class Standing(NamedTuple):
    """The fraction by which a pattern at rest makes displacements too small.

    fraction: 0 where no pattern was detected.
    stderr: from the scatter over the images.
    """

    fraction: float = 0.0
    stderr: float = 0.0

    @property
    def spoils(self) -> bool:
        """Whether the pattern is too strong for a correction."""
        return self.fraction > _LARGEST

    def corrected(self, displacement: Displacement) -> Displacement:
        """Displacements without their bias, and with its uncertainty.

        displacement: with a covariance.
        """
        if not self.fraction or self.spoils or displacement.covariance is None:
            return displacement
        left = 1 - self.fraction
        d = displacement.d / left
        variance = self.stderr**2 + (_UNLIKE * self.fraction) ** 2
        unit = torch.eye(len(d)).to(d).reshape(len(d), len(d), *[1] * (d.ndim - 1))
        more = variance * d.square().sum(0) * unit
        return displacement._replace(d=d, covariance=displacement.covariance / left**2 + more)

    def __str__(self) -> str:
        return f"{self.fraction:.1%} of the texture does not move" if self.fraction else ""


def standing(
    images: Sequence[torch.Tensor],
    displacement: Displacement,
    windows: Windows,
    false_alarm: float = FALSE_ALARM,
) -> Standing:
    """The fraction of displacements that a pattern at rest takes, from what they do not explain.

    A pattern p at rest in air that moves by d leaves r = p(x + d/2) - p(x - d/2) between images
    warped to mid-time, of spectral density 4 sin^2(k.d / 2) P(k): more in waves along d than
    across it. Of noise, other air and out-of-plane motion both have as much. With the Riesz
    transforms r_z, r_y (i k_z / |k|, i k_y / |k| in the spectrum), along and across d,

        <r_along^2 - r_across^2> = d^2 / 4 <|grad p|^2>

    for small d. The same of the images' mean m, q = m(x + d/2) - m(x - d/2), gives the gradients of
    all structure. The ratio is the fraction of the squared gradients that is at rest, and as much
    do displacements lack that are fitted to the gradients. Both are summed over blocks of 24 px,
    weighted by what a pattern would give over the square of what the displacements leave. The
    ratio counts if it exceeds its standard error, from the scatter of the blocks, by Student's t
    at the rate of false alarms, and 0.015.

    images (z, y): the first two of them count. Of volumes none is found.
    displacement: a field fitted to the images as a whole.
    """
    if windows.dims > 2:
        return Standing()
    left, mean, known, d = residual(images[:2], displacement, windows)
    speed = d.norm(dim=0)
    use = known & (speed > _SLOWEST) & inner(known, _RIM)
    if not bool(use.any()):
        return Standing()
    limit = _CLIPPED * 1.4826 * left[use].abs().median()
    shift = moved(mean, d / 2) - moved(mean, -d / 2)
    excess, power = _along_and_across(left.clamp(-limit, limit), d / speed.clamp(min=1e-6))
    whole, _ = _along_and_across(shift, d / speed.clamp(min=1e-6))
    sums = torch.stack([excess, power, whole, torch.ones_like(power)]) * use
    sums = in_blocks(sums, _BLOCK).sum(-1)
    sums = sums[:, (sums[3] > _BLOCK**2 / 4) & (sums[1] > 0)].cpu()
    number = sums.shape[1]
    if number < _FEW_BLOCKS:
        return Standing()
    excess, power, whole, pixels = sums
    weight = (whole * pixels / power**2).clamp(min=0)
    total = float((weight * whole).sum())
    if not total > 0:
        return Standing()
    fraction = float((weight * excess).sum()) / total
    scatter = (weight * (excess - fraction * whole)).square().sum() * number / (number - 1)
    stderr = float(scatter.sqrt()) / total
    if fraction <= max(_LEAST, student.isf(false_alarm, number - 1) * stderr):
        return Standing()
    return Standing(fraction, stderr)


def residual(
    images: Sequence[torch.Tensor], displacement: Displacement, windows: Windows
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Difference and mean of two images over their means at mid-time, where known, the motion, px.

    The difference is without the means of its columns and rows: lines that have an offset of their
    own in each image have structure across and along the motion too.
    """
    weights = [
        linear_weights(windows.centres(axis).to(displacement.d), torch.arange(n).to(displacement.d))
        for axis, n in enumerate(windows.shape)
    ]
    one, two = (working(image) for image in images)
    d = separable(displacement.d.nan_to_num(0.0), weights).to(one)
    lost = separable((~torch.isfinite(displacement.d)).any(0).to(displacement.d), weights) > 0
    known = torch.isfinite(one) & torch.isfinite(two) & ~lost
    one, two = (torch.where(known, i / i[known].mean(), 1.0) for i in (one, two))
    hole = (~known).to(one)
    known = (moved(hole, -d / 2) < 0.1) & (moved(hole, d / 2) < 0.1)
    first, second = moved(one, -d / 2), moved(two, d / 2)
    difference = torch.where(known, second - first, torch.nan)
    return without_lines(difference).nan_to_num(0.0), (first + second) / 2, known, d


def without_lines(field: torch.Tensor) -> torch.Tensor:
    """A field (z, y) less the means of its columns and of its rows; of volumes all lines."""
    for axis in range(field.ndim):
        field = field - field.nanmean(axis, keepdim=True)
    return field


def inner(pixels: torch.Tensor, rim: int) -> torch.Tensor:
    """All pixels but those of a rim, True."""
    inside = torch.zeros_like(pixels, dtype=torch.bool)
    inside[tuple(slice(rim, n - rim) for n in pixels.shape)] = True
    return inside


def in_blocks(fields: torch.Tensor, side: int) -> torch.Tensor:
    """Fields (n, ...) cut into blocks of this side, (n, blocks, pixels)."""
    dims = fields.ndim - 1
    for axis in range(1, dims + 1):
        fields = fields.unfold(axis, side, side)
    return fields.flatten(dims + 1).flatten(1, dims)


def _along_and_across(image: torch.Tensor, unit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Squares of the Riesz transforms along and across unit vectors (2, z, y): difference, sum."""
    kz, ky = torch.meshgrid(*(torch.fft.fftfreq(n).to(image) for n in image.shape), indexing="ij")
    length = torch.hypot(kz, ky)
    length[0, 0] = 1.0
    spectrum = torch.fft.fft2(image - image.mean())
    z, y = (torch.fft.ifft2(spectrum * 1j * k / length).real for k in (kz, ky))
    along, across = z * unit[0] + y * unit[1], y * unit[0] - z * unit[1]
    return along**2 - across**2, along**2 + across**2
