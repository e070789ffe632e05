"""Offsets of the images' columns and rows, estimated together with the flow.

A detector that is read out line by line, and a lamp that flickers meanwhile, give each line of each
image an offset of its own. A fit without them takes a part of them for motion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.likelihood import Images, Linear, path
from lidar_mi.retrieval.flow.posterior import Response
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.spline import splines_of_values_and_slopes
from lidar_mi.retrieval.images.windows import working

# Fits of flow and offsets in turn.
_MOST_FITS = 6
# Power of the residual in waves across the lines alone over that in waves of 3 to 8 periods along
# them from which offsets are estimated, which takes as long as the fit: 1.2 to 2.8 in clean images.
_SUSPECTED, _OTHERS = 2.0, slice(3, 9)
# Twice the log-likelihood ratio from which there are offsets. Of 10.8 one image in a thousand has
# more by chance; clean images have up to 19 by motion that the flow does not resolve.
_LEAST = 30.0
# Change of the offsets, over their standard error, from which the flow is fitted again.
_SETTLED = 0.1
_NAMES = "rows", "columns"


class LineOffsets(NamedTuple):
    """Offsets of lines of two images, in units of the normalised images.

    axes: 0: rows, 1: columns.
    values (lines,): of all rows of image 1, then of image 2; then of the columns.
    flows (n, components, knots): independent errors of the flow by those of the offsets.
    images (z, y): normalised, without the offsets.
    fits: from which they were estimated in turn.
    change: by the last one, rms over the standard errors.
    suspected: whether the images that were fitted last look as if their lines had offsets.
    """

    axes: tuple[int, ...]
    values: torch.Tensor
    flows: torch.Tensor
    images: list[torch.Tensor]
    fits: int
    change: float
    suspected: bool

    @property
    def settled(self) -> bool:
        """Whether another fit would not change them, or was one too many."""
        return self.change < _SETTLED or self.fits >= _MOST_FITS

    @property
    def explain(self) -> bool:
        """Whether they explain the images: nothing like them is left, or the fits converge."""
        return not self.suspected if self.change < _SETTLED else self.settled and self.change < 1

    @property
    def names(self) -> str:
        """Which lines have offsets."""
        return " and ".join(_NAMES[axis] for axis in reversed(self.axes))


def line_offsets(
    images: Images,
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    settings: VariationalSettings,
    response: Response,
    before: LineOffsets | None = None,
) -> LineOffsets | None:
    """Offsets of lines, of variance v, that the images have next to the flow; None without any.

    To first order about the flow u the difference of the warped images is D = -J du + T c + e, with
    the lines T of both images, filtered and warped as these are. With R T, what the fit leaves of
    T, the most probable offsets are (T^T W R T + 1 / v)^-1 T^T W D, and the inverse is their
    covariance, which allows for the error of the flow; v is that of the largest restricted
    likelihood (to a fifth). The flow errs by -C J^T W T times their errors. As the likelihood is
    not linear, flow and offsets are estimated in turn, from images without the offsets before.
    Other structure that is taken for offsets remains, or grows from fit to fit. The first ones are
    those of R = 1: a flow that has taken offsets for motion has a prior so weak that it would keep
    them. Images are already without the offsets ``before``; all else is of the flow.
    """
    time = images.time / images.time.square().sum()
    slope, weight = working(linear.slope), working(linear.weight)
    residual = working((time.reshape(-1, 1, 1) * linear.warped).sum(0) * linear.valid)
    axes = before.axes if before else ()
    excess = [_excess(residual * weight.sqrt(), axis) for axis in (0, 1)]
    # one at a time: what the flow mistakes for motion looks like lines of both kinds
    new = max((axis for axis in (0, 1) if axis not in axes), key=excess.__getitem__, default=0)
    if new not in axes and excess[new] > _SUSPECTED:
        axes = *axes, new
    if not axes:
        return None
    places = path(mesh, coefficients, images.time, settings.path_order)
    lines = torch.cat([_lines(images, places, time, axis) for axis in axes]) * linear.valid
    flows = response(mesh.transposed(-lines[:, None] * (slope * weight)))
    left = (lines + (slope * mesh.field(flows)).sum(1)) * linear.valid
    weighted = (lines * weight).flatten(1)
    gradient = weighted @ residual.flatten()
    known = _padded(before, len(lines), gradient)
    information = _symmetric(weighted @ left.flatten(1).T)
    ratio, values, root = most_probable(information, gradient + information @ known)
    if not before:
        if ratio < _LEAST:
            return None
        values = most_probable(_symmetric(weighted @ lines.flatten(1).T), gradient)[1]
    change = values - known
    # the last change counts as an error
    errors = torch.cat([root, change[:, None]], 1)
    flows = (errors.T @ flows.flatten(1)).reshape(-1, *flows.shape[1:])
    return LineOffsets(
        axes,
        values,
        flows,
        _without(images.stack, axes, change),
        before.fits + 1 if before else 1,
        float(change @ information @ change / len(values)) ** 0.5,
        max(excess) > _SUSPECTED,
    )


def most_probable(
    information: torch.Tensor, gradient: torch.Tensor
) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Normal numbers (n,) of the most likely common variance, and a root of their covariance.

    From the data's information (n, n) on them, and the gradient (n,) of the log-likelihood where
    all are 0. First is twice the logarithm of the likelihood over that of the variance 0; the
    covariance is root root^T.
    """
    precision, waves = torch.linalg.eigh(information)
    precision, along = precision.clamp(min=0.0), waves.T @ gradient
    largest = (gradient / information.diagonal().clamp(min=1e-30)).square().mean()
    variance = largest * 2.0 ** torch.arange(-12, 13, 0.5).to(largest)[:, None]
    kept = variance / (1 + variance * precision)
    ratios = (kept * along.square() - (variance * precision).log1p()).sum(1)
    best = int(ratios.argmax())
    return float(ratios[best]), waves @ (kept[best] * along), waves * kept[best].sqrt()


def _without(
    images: torch.Tensor, axes: Sequence[int], offsets: torch.Tensor
) -> list[torch.Tensor]:
    parts = iter(offsets.split([n for a in axes for n in (images.shape[1 + a],) * 2]))
    for axis in axes:
        of_lines = torch.stack([next(parts), next(parts)]).to(images)
        images = images - of_lines.unsqueeze(2 - axis)
    return list(images)


def _symmetric(matrix: torch.Tensor) -> torch.Tensor:
    return (matrix + matrix.T) / 2


def _padded(offsets: LineOffsets | None, number: int, like: torch.Tensor) -> torch.Tensor:
    """Values of so many lines, 0 where none are known."""
    values = torch.zeros(number).to(like)
    if offsets:
        values[: len(offsets.values)] = offsets.values
    return values


def _excess(white: torch.Tensor, axis: int) -> float:
    """Power of a field in waves across its rows (axis 0) or columns over that in others."""
    across = white.movedim(axis, 0)
    taper = torch.hann_window(across.shape[1], periodic=False).to(white)
    power = torch.fft.rfft(across * taper).abs().square().sum(0)
    return float(power[0] / power[_OTHERS].mean().clamp(min=1e-30))


def _lines(images: Images, places: torch.Tensor, time: torch.Tensor, axis: int) -> torch.Tensor:
    """What an offset of 1 of each line of each image adds to the residual, (lines, z, y)."""
    shape = images.spline.shape
    one = torch.eye(shape[axis]).to(images.spline.coefficients)
    one = one.unsqueeze(2 - axis).expand(-1, *shape).contiguous()
    spline, _ = splines_of_values_and_slopes(one, images.chosen, images.spline.settings)
    fields = [
        weight * spline.values(*(place[image].expand_as(one).contiguous() for place in places))
        for image, weight in enumerate(time)
    ]
    return working(torch.cat(fields))
