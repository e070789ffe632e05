"""Standard errors of vectors from windows, by retrieving a known motion (bootstrap).

A window's displacement errs because the images differ (noise, air that changes), because the wind
varies within the window, because paths are curved and because the peak is no Gaussian between whole
pixels. How these add up depends on the method. So the method is applied to an image pair that
differs from the given one only in that its motion is known: image 1, and image 1 moved by the
retrieved wind plus the residual of the given pair.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch.nn.functional import grid_sample

from lidar_mi.retrieval.velocimetry.brightness import normalised
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.outliers import median_outliers, validated
from lidar_mi.retrieval.velocimetry.quality import filled
from lidar_mi.retrieval.velocimetry.warping import band_limited
from lidar_mi.retrieval.velocimetry.windows import (
    Windows,
    averaged,
    linear_weights,
    separable,
    working,
)

# Templates by which the residual is moved along z and y, away from the texture that it is of.
_APART = ((2, 2), (-2, 2))
# Standard deviations of Gaussian means over the template: of squared errors, of the residual's
# level, of squared gradients.
_REGION, _LEVEL, _SHEAR = 1.5, 3.0, 0.35
# Independent windows of known error within those means (`_REGION`) that a variance needs: of the
# two components of five windows, it is known to 45 %.
_FEWEST = 5.0
# Gradient, px per px, of a wind that is uniform.
_UNIFORM = 0.01
# Least standard error, px: splines do not carry an image more exactly.
_LEAST = 1e-3
# Times that what a window's average takes away is added.
_SHARPENINGS = 2
# Steps of a path, rounds of the place at mid-time.
_STEPS, _ROUNDS = 4, 3


def bootstrap_covariance(
    images: Sequence[torch.Tensor],
    found: Displacement,
    windows: Windows,
    retrieve: Callable[..., Displacement],
    centred: bool,
    repeats: int = 1,
    textured: torch.Tensor | None = None,
) -> torch.Tensor:
    """Covariance of the displacements' errors, from further retrievals of a known motion.

    A parametric bootstrap with resampled residuals (Efron & Tibshirani 1993, An Introduction to the
    Bootstrap, ch. 6 and 9). In PIV, the residual of images matched by the measured displacements
    states the random error (Sciacchitano, Wieneke & Scarano 2013, Meas. Sci. Technol. 24, 045302;
    Wieneke 2015, Meas. Sci. Technol. 26, 074002), and synthetic images of known motion state the
    error of the algorithm (Timmins et al. 2012, Exp. Fluids 53, 1133-1147). One pair states both:

    - Its wind is that of the vectors, outliers replaced, and sharpened: the vectors are averages
      of the true wind over a window of n px, as by a Gaussian G of standard deviation n / sqrt(12).
      d + (1 - G) d + (1 - G)^2 d is the second iterate of its inverse (van Cittert 1931, Z. Phys.
      69, 298-308).
    - Image 1 is carried along paths in that wind.
    - The residual, image 2 less image 1 so carried, is moved by two templates along both axes,
      scaled to the level (over Gaussians of 3 templates) at its new place, and added. So noise and
      changes keep their size and correlation length, but are independent of the texture.

    With e the error of a vector retrieved from this pair, where it is valid, the covariance is

        C = p^2 <e e^T / p^2>,  p^2 = |grad d|^2 + median(|grad d|^2),

    <> being the mean over a Gaussian of 1.5 templates, and |grad d|^2 that over one of 0.35: shear
    varies over shorter distances than the mean needs for enough independent errors.

    These numbers were chosen on seeds 41 to 43 of the cases of ``validation/coverage.py``. With one
    iterate, the standard errors of "cc" are 7 % smaller; with a mean over 1 template the variance
    of normalised errors is 10 to 15 % larger. The wind is not known better than its vectors: in
    vortex cores smaller than a window, standard errors are too small. Beside a steep edge of
    brightness that stands still (from 1 to 0.2 within 4 px) they are 3 to 6 times too large up to
    three templates away, as what is left at the edge counts as noise there.

    Parameters
    ----------
    images : sequence of torch.Tensor, shape (z, y)
        The two images.
    found : Displacement
        Retrieved from them.
    windows : Windows
    retrieve : callable
        (image1, image2, stride=...) -> Displacement, the method with its options.
    centred : bool
        Vectors belong to the windows' centres, not half their displacement further on.
    repeats : int
        1 or 2 retrievals: the residual is moved to opposite sides.
    textured : torch.Tensor of bool, shape windows.count, optional
        Windows whose errors count; left out: all. Errors of windows that hold nothing say nothing
        of their neighbours.

    Returns
    -------
    torch.Tensor, shape (2, 2, *windows.count)
        px^2; NaN where fewer than five independent windows around (valid retrievals, within the
        Gaussian of 1.5 templates) have a known error.
    """
    # vectors of windows that overlap by more than half would cost more and tell little
    every = max(1, windows.template // 2 // windows.stride)
    coarse = replace(windows, stride=every * windows.stride)
    d = working(found.d)[:, ::every, ::every]
    per_template = windows.template / coarse.stride
    flow, _ = validated(d, max(1, round(per_template / 2)))
    window = per_template / math.sqrt(12)
    everywhere = torch.ones_like(flow[0], dtype=torch.bool)
    shear = averaged(_squared_gradient(flow) / coarse.stride**2, everywhere, _SHEAR * per_template)
    lost = flow
    for _ in range(_SHARPENINGS):
        lost = lost - torch.stack([averaged(part, everywhere, window) for part in lost])
        flow = flow + lost

    wind = _at_mid_time(flow, coarse, centred)
    first, second = normalised(images)
    carried = _carried(filled(first), wind)
    rest = torch.where(second.isfinite(), second - carried, 0.0)
    level = averaged(rest.square(), second.isfinite(), _LEVEL * windows.template).sqrt()
    level = level.clamp(min=torch.finfo(rest.dtype).tiny)
    scale = shear + shear.median().clamp(min=_UNIFORM**2)
    means, number = [], torch.zeros_like(scale)
    for apart in _APART[:repeats]:
        moved = (rest / level).roll([windows.template * part for part in apart], (0, 1))
        moved = torch.where(second.isfinite(), level * moved, torch.nan)
        again = retrieve(first, carried + moved, stride=coarse.stride)
        outlier = median_outliers(again.d, 3, max(1, round(per_template / 2)))
        use = (again.flag == 0) & ~outlier
        if textured is not None:
            use &= textured[::every, ::every]
        if not bool(use.any()):
            continue
        error = again.d - _read(wind, _places(again.d, coarse, centred))
        products = torch.einsum("i...,j...->ij...", error, error).flatten(0, 1) / scale
        width = _REGION * per_template
        means += [torch.stack([averaged(p, use, width) for p in products])]
        number += 2 * math.pi * _REGION**2 * averaged(use.to(number), everywhere, width)
    if not means:
        return torch.full_like(found.d[None].expand(2, -1, -1, -1), torch.nan)
    weights = [
        linear_weights(*(frame.centres(axis).to(d) for frame in (coarse, windows)))
        for axis in (0, 1)
    ]
    covariance = separable(torch.stack(means).mean(0) * scale, weights).unflatten(0, (2, 2))
    covariance[:, :, separable(number, weights) < _FEWEST] = torch.nan
    return covariance + _LEAST**2 * torch.eye(2).to(d)[:, :, None, None]


def _squared_gradient(flow: torch.Tensor) -> torch.Tensor:
    """Sum of the squared differences per vector of all components along both axes."""
    total = torch.zeros_like(flow[0])
    for axis in (1, 2):
        if flow.shape[axis] > 1:
            total += torch.gradient(flow, dim=axis)[0].square().sum(0)
    return total


def _at_mid_time(flow: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Displacement (2, z, y) in dt of the air that is at each pixel at mid-time."""
    weights = [
        linear_weights(windows.centres(axis).to(flow), torch.arange(n).to(flow))
        for axis, n in enumerate(windows.shape)
    ]
    start = wind = separable(flow, weights)
    if not centred:
        pixels = _pixels(windows.shape, flow)
        for _ in range(_ROUNDS):
            wind = _read(start, pixels - wind / 2)
    return wind


def _carried(image: torch.Tensor, wind: torch.Tensor) -> torch.Tensor:
    """The image along paths in a steady wind (2, z, y), px per time step, one time step later."""
    place = _pixels(image.shape, wind)
    for _ in range(_STEPS):
        half = place - _read(wind, place) / (2 * _STEPS)
        place = place - _read(wind, half) / _STEPS
    spline, _ = band_limited([image])
    return spline.sample(*place[:, None])[0][0]


def _places(d: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Of vectors at mid-time, px (2, ...)."""
    centres = [windows.centres(axis).to(d) for axis in (0, 1)]
    along = torch.stack(torch.meshgrid(*centres, indexing="ij"))
    return along + (0.0 if centred else 0.5) * d.nan_to_num(0.0)


def _pixels(shape: Sequence[int], like: torch.Tensor) -> torch.Tensor:
    return torch.stack(torch.meshgrid(*(torch.arange(n).to(like) for n in shape), indexing="ij"))


def _read(field: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """A field (n, z, y) on pixels at places (2, ...) between them, linearly; the rim's outside."""
    last = [max(1, n - 1) for n in field.shape[1:]]
    across = torch.stack([2 * p / n - 1 for p, n in zip(place, last, strict=True)][::-1], -1)
    return grid_sample(field[None], across[None], "bilinear", "border", align_corners=True)[0]
