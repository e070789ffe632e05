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
from functools import reduce

import torch
from torch.nn.functional import grid_sample, pad

from lidar_mi.retrieval.correlation.outliers import median_outliers, validated
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.inpainting import filled_in
from lidar_mi.retrieval.images.intensity import normalised
from lidar_mi.retrieval.images.noise_map import known_and_weight
from lidar_mi.retrieval.images.quality import Flag
from lidar_mi.retrieval.images.settings import VOLUME_FILTER, FilterSettings
from lidar_mi.retrieval.images.spline import band_limited
from lidar_mi.retrieval.images.windows import (
    Windows,
    averaged,
    linear_weights,
    separable,
    strided,
    working,
)

# Templates by which the residual is moved along z and y, away from the texture that it is of.
_SEPARATIONS = ((2, 2), (-2, 2))
# Standard deviations of Gaussian means over the template: of squared errors, of the residual's
# level, of squared gradients, of squared second differences, of the fraction of clear texture.
_REGION, _LEVEL, _SHEAR, _ROUGHNESS, _AROUND = 1.5, 1.25, 0.35, 0.7, 4.5
# Independent windows of known error within those means (`_REGION`) that a variance needs: of the
# two components of five windows, it is known to 45 %.
_FEWEST = 5.0
# Fraction of textured windows in which the known motion must be recovered: a method that fails in
# most of them has errors that the others do not show.
_FOUND = 0.5
# Fraction of textured windows that must be clearly so: else most of them are by chance.
_CLEAR = 0.5
# Steps to the largest likelihood of the variances. A thousand change standard errors by 3 % or less
# in the median, of single vectors by up to a quarter: of factors that vanish, slowly.
_ITERATIONS = 50
# Least standard error, px: splines do not advect an image more exactly.
_LEAST = 1e-3
# Times that what a window's average takes away is added.
_SHARPENINGS = 2
# Least fraction of the residual's variance that is not stated elsewhere.
_REMAINING = 0.1
# Of the splines that advect an image or a volume.
_FILTERS = {2: FilterSettings(), 3: VOLUME_FILTER}
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
    clear: torch.Tensor | None = None,
    stated: torch.Tensor | None = None,
    noise: float | torch.Tensor | None = None,
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
    - Image 1 is advected along paths in that wind.
    - The residual, image 2 less image 1 so advected, is moved by two templates along both axes,
      scaled to the level (over Gaussians of 1.25 templates, times the noise where that is known of
      each pixel) at its new place, and added. So noise and changes keep their size and correlation
      length, but are independent of the texture.

    With e the error of a vector retrieved from this pair, where it is valid, the covariance is

        C_ij = p_i p_j <e_i e_j / (p_i p_j)>,  p_i^2 = sum_k a_k x_ki,  a_k >= 0,

    <> being the mean over a Gaussian of 1.5 templates. That mean needs many errors, and errors vary
    over shorter distances, as in vortex cores: that is what the variances p^2 are for. They are the
    sum of these that makes the errors of this very pair most likely (`_most_likely`):

    - x = 1;
    - x = s^2 (J^-1)_ii, J the mean over the window of the products of image 1's slopes: differences
      of the images, of the variance s^2 where it is known of each pixel, displace a vector by that
      (Cramer-Rao);
    - windows that are not deformed: (flow - d)_i^2, which the window's average takes away;
    - windows that are (`centred`): the square of |grad d|^2 over a Gaussian of 0.35 template, as
      their fit leaves errors of second order in the gradient; and |D d|^2 over one of 0.7, D the
      sum of the second differences along both axes. Of the errors e it is |D (e + G d)|^2: where
      vectors are rougher than the errors of the known motion, larger errors are stated.

    Where most windows around (Gaussian of 4.5 templates) that are textured are not `clear`, the few
    that are passed the tests of texture by chance, and their errors are no evidence.
    Where the known motion is recovered in less than half of them, nor are the errors of these.

    These predictors and numbers were chosen on seeds 41 to 46 of the cases of
    ``validation/coverage.py``. With one iterate of the sharpening, the standard errors of "cc" are
    4 to 7 % smaller. Where air is advected exactly, with <> over 1 template the variance of
    normalised errors is 10 to 15 % larger, and with the level over 3 templates "multipass" has 2 to
    3 points more errors within one standard error. In rendered images, whose noise grows with
    brightness, a level that does not vary as the noise makes standard errors of "cc" and
    "multipass" in the dim air around smoke up to 1.5 times too large.

    The wind is not known better than its vectors: in vortex cores smaller than a window, standard
    errors are too small, and so they are where air changes as if it moved: see
    `coherent_windows.coherent_change`. On a steep edge of brightness that stands still (from 1 to
    0.2 within 4 px) vectors of "multipass" err by three standard errors; on its bright side, up to
    three templates away, errors are stated 1.5 to 2 times too large.

    Parameters
    ----------
    images : sequence of torch.Tensor, shape (z, y), or (x, z, y) of volumes
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
        Windows whose errors count; default: all. Errors of windows that hold nothing say nothing
        of their neighbours.
    clear : torch.Tensor of bool, shape windows.count, optional
        Windows that pass thresholds of texture half as high again; default: all.
    stated : torch.Tensor, shape (z, y), optional
        Variance of the residual by changes whose errors are stated elsewhere: it is taken away from
        the residual's, of which a tenth remains at least.
    noise : float or torch.Tensor, optional
        Standard deviation of the images' noise. Where it is known of each pixel, the residual's
        level and the errors are taken to vary as it does.

    Returns
    -------
    torch.Tensor, shape (axes, axes, *windows.count)
        px^2; NaN where fewer than five independent windows around (valid retrievals, within the
        Gaussian of 1.5 templates) have a known error, and where fewer than half of the textured
        windows around are clear, or have one.
    """
    # vectors of windows that overlap by more than half would cost more and add little
    every = max(1, windows.template // 2 // windows.stride)
    coarse = replace(windows, stride=every * windows.stride)

    def some(field: torch.Tensor) -> torch.Tensor:
        return reduce(lambda part, axis: strided(part, every, axis), range(-windows.dims, 0), field)

    d = some(working(found.d))
    per_template = windows.template / coarse.stride
    flow, replaced = validated(d, max(1, round(per_template / 2)))
    window = per_template / math.sqrt(12)
    everywhere = torch.ones_like(flow[0], dtype=torch.bool)
    known = everywhere if textured is None else some(textured)

    def of_windows(field: torch.Tensor) -> torch.Tensor:
        return torch.stack([averaged(part, everywhere, window) for part in field])

    vectors, smooth = flow, of_windows(flow)
    for _ in range(_SHARPENINGS):
        flow = flow + vectors - of_windows(flow)

    wind = at_mid_time(flow, coarse, centred)
    first, second = normalised(images)
    advected, inside = _advected(first, wind)
    # of air that came in nothing is known
    compared = second.isfinite() & inside
    residual = torch.where(compared, second - advected, 0.0)
    # smoothed, as a noise from few samples is itself noisy; 1 where none is known
    _, weight = known_and_weight(images, noise)
    known_noise = 1 / weight.to(residual)

    def about(variance: torch.Tensor) -> torch.Tensor:
        mean = averaged(variance / known_noise, compared, _LEVEL * windows.template)
        return known_noise * mean

    square = about(residual.square())
    level = square.sqrt().clamp(min=torch.finfo(residual.dtype).tiny)
    added = level
    if stated is not None:
        added = (square - about(stated)).clamp(min=_REMAINING * square).sqrt()
    cramer_rao = coarse.of_templates(known_noise) * _inverse_texture(filled_in(first), coarse)
    same = [torch.ones_like(flow), cramer_rao]
    if centred:
        shear = averaged(_squared_gradient(vectors), everywhere, _SHEAR * per_template)
        same.append(shear.square().expand_as(flow))
        valid = known & ~replaced & some(_unflagged(found))
        own = [_roughness(vectors, valid, _ROUGHNESS * per_template)]
    else:
        same.append((flow - vectors).square())
        own = []
    predictors = torch.stack([*same, *own])
    tried, number, recovered = [], torch.zeros_like(flow[0]), torch.zeros_like(flow[0])
    width = _REGION * per_template
    for separation in _SEPARATIONS[:repeats]:
        moved = (residual / level).roll([windows.template * part for part in separation], (-2, -1))
        moved = torch.where(second.isfinite(), added * moved, torch.nan)
        again = retrieve(first, advected + moved, stride=coarse.stride)
        outlier = median_outliers(again.d, 3, max(1, round(per_template / 2)))
        use = _unflagged(again) & ~outlier & known
        if not bool(use.any()):
            continue
        error = again.d - _read(wind, _places(again.d, coarse, centred))
        # the advecting wind is as rough as the vectors: their mean stands for the true one
        roughness = [
            _roughness(_continued(error, use) + smooth, use, _ROUGHNESS * per_template)
        ] * len(own)
        tried.append((error, use, torch.stack([*same, *roughness])))
        number += _in_a_mean(windows) * averaged(use.to(number), everywhere, width)
        recovered += averaged(use.to(number), known, _AROUND * per_template) / repeats
    if not tried:
        return torch.full_like(torch.stack([found.d] * windows.dims), torch.nan)
    factors = _most_likely(
        torch.cat([x[:, :, use].flatten(1) for _, use, x in tried], 1),
        torch.cat([error[:, use].flatten() for error, use, _ in tried]).square() + _LEAST**2,
    )
    means = []
    for error, use, x in tried:
        scaled = error / torch.tensordot(factors, x, 1).sqrt()
        products = torch.einsum("i...,j...->ij...", scaled, scaled).flatten(0, 1)
        means.append(torch.stack([averaged(p, use, width) for p in products]))
    scale = torch.tensordot(factors, predictors, 1).sqrt()
    covariance = torch.stack(means).mean(0).unflatten(0, (windows.dims,) * 2)
    covariance = covariance * scale[:, None] * scale[None]
    number = torch.where(recovered < _FOUND, 0.0, number)
    if clear is not None:
        part = averaged(some(clear).to(scale), known, _AROUND * per_template)
        number = torch.where(part < _CLEAR, 0.0, number)
    weights = [
        linear_weights(*(frame.centres(axis).to(d) for frame in (coarse, windows)))
        for axis in range(windows.dims)
    ]
    covariance = separable(covariance, weights)
    number = separable(number, weights)
    # errors of the same windows with another residual are hardly further ones
    covariance = covariance * _widened(number / repeats, windows.dims)
    covariance[:, :, number < _FEWEST] = torch.nan
    least = _LEAST**2 * torch.eye(windows.dims).to(d)
    return covariance + least.reshape(*least.shape, *[1] * windows.dims)


def _unflagged(found: Displacement) -> torch.Tensor:
    """Vectors that are valid, be it from what is finite in their windows."""
    flag = found.flag & ~Flag.NON_FINITE_INPUT.value
    return (flag == 0) & found.d.isfinite().all(0)


def _in_a_mean(windows: Windows) -> float:
    """Windows that do not overlap within the Gaussian mean of squared errors, or in all."""
    inside = math.prod(1 + (n - 1) * windows.stride / windows.template for n in windows.count)
    return min(_of_a_mean(windows.dims), inside)


def _of_a_mean(dims: int) -> float:
    return (2 * math.pi) ** (dims / 2) * _REGION**dims


def _widened(number: torch.Tensor, dims: int) -> torch.Tensor:
    """Variance of errors over the square of a standard error from so many windows.

    With f errors in a mean, normalised errors have Student's distribution, of the variance f /
    (f - 2). The factor is over that of a full mean (`_of_a_mean`), with which the predictors were
    chosen.
    """
    degrees, full = dims * number.clamp(min=_FEWEST / 2), dims * _of_a_mean(dims)
    return (degrees / (degrees - 2) * (full - 2) / full).clamp(min=1.0)


def enough_windows(windows: Windows) -> bool:
    """Whether images hold as many windows that do not overlap as one mean of squared errors."""
    return math.prod(n / windows.template for n in windows.shape) >= _of_a_mean(windows.dims)


def _most_likely(predictors: torch.Tensor, squares: torch.Tensor) -> torch.Tensor:
    """Factors a >= 0 by which the variances a x make squared errors of normal errors most likely.

    Of predictors x (k, n) and squares e^2 (n,): the minimum of sum(ln s + e^2 / s), s = sum a_k
    x_k, by multiplicative steps that never increase it (Févotte & Idier 2011, Neural Comput. 23,
    2421-2456, majorisation and minimisation for beta = 0).
    """
    tiny = torch.finfo(predictors.dtype).tiny ** 0.25
    unit = predictors.mean(1).clamp(min=tiny)
    size = squares.mean().clamp(min=tiny)
    x, y = predictors / unit[:, None], squares / size
    a = torch.full_like(unit, 1 / len(unit))
    for _ in range(_ITERATIONS):
        s = (a @ x).clamp(min=tiny)
        a = a * ((x @ (y / s.square())) / (x @ (1 / s)).clamp(min=tiny)).sqrt()
    return a * size / unit


def _inverse_texture(image: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Diagonal (axes, *windows.count) of the inverse mean product of an image's slopes, px^2."""
    slopes = torch.stack(torch.gradient(image))
    j = torch.einsum("i...,j...->...ij", *[slopes] * 2).movedim((-2, -1), (0, 1))
    j = windows.of_templates(j).movedim((0, 1), (-2, -1))
    # windows with nothing in them are in no mean, but must not be infinite
    least = 1e-6 * j.diagonal(dim1=-2, dim2=-1).mean().clamp(min=torch.finfo(j.dtype).tiny ** 0.25)
    inverse = torch.linalg.inv(j + least * torch.eye(windows.dims).to(j))
    return inverse.diagonal(dim1=-2, dim2=-1).movedim(-1, 0)


def _squared_gradient(flow: torch.Tensor) -> torch.Tensor:
    """Sum of the squared differences per vector of all components along all axes."""
    slopes = [_slope(flow, axis).square().sum(0) for axis in range(1, flow.ndim)]
    return torch.stack(slopes).sum(0)


def _roughness(flow: torch.Tensor, use: torch.Tensor, width: float) -> torch.Tensor:
    """Gaussian mean of the squared second differences, the same for all components (axes, ...).

    Of vectors that are in use with their neighbours two vectors away, which have pixels of their
    own.
    """
    curvature = torch.stack([_slope(_slope(flow, axis), axis) for axis in range(1, flow.ndim)]).sum(
        0
    )
    wide = pad(use, (2, 2) * use.ndim, value=True)
    around = [use]
    for axis, n in enumerate(use.shape):
        inside = [slice(2, -2)] * use.ndim
        for start in (0, 4):
            inside[axis] = slice(start, start + n)
            around.append(wide[tuple(inside)])
    mean = averaged(curvature.square().mean(0), torch.stack(around).all(0), width)
    return mean.expand_as(flow)


def _continued(field: torch.Tensor, use: torch.Tensor) -> torch.Tensor:
    """A field (n, z, y) with the mean of what is around where it is not in use."""
    return torch.stack([torch.where(use, part, averaged(part, use, 1.0)) for part in field])


def _slope(field: torch.Tensor, axis: int) -> torch.Tensor:
    """Differences per vector, zero along an axis with a single one."""
    if field.shape[axis] < 2:
        return torch.zeros_like(field)
    return torch.gradient(field, dim=axis)[0]


def at_mid_time(flow: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Displacement (axes, ...) in dt of the air that is at each pixel at mid-time."""
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


def _advected(image: torch.Tensor, wind: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The image along paths in a steady wind (axes, ...), px per time step, one time step later.

    And where there is any.
    """
    place = _pixels(image.shape, wind)
    for _ in range(_STEPS):
        half = place - _read(wind, place) / (2 * _STEPS)
        place = place - _read(wind, half) / _STEPS
    spline, _ = band_limited([image], settings=_FILTERS[image.ndim])
    at = place[:, None].to(spline.coefficients)
    return spline.sample(*at)[0][0].to(wind), spline.holds(*at)[0]


def _places(d: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Of vectors at mid-time, px (axes, ...)."""
    centres = [windows.centres(axis).to(d) for axis in range(windows.dims)]
    along = torch.stack(torch.meshgrid(*centres, indexing="ij"))
    return along + (0.0 if centred else 0.5) * d.nan_to_num(0.0)


def _pixels(shape: Sequence[int], like: torch.Tensor) -> torch.Tensor:
    return torch.stack(torch.meshgrid(*(torch.arange(n).to(like) for n in shape), indexing="ij"))


def _read(field: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """A field (n, ...) on pixels at places (axes, ...) between them, linearly; outside, the rim."""
    last = [max(1, n - 1) for n in field.shape[1:]]
    across = torch.stack([2 * p / n - 1 for p, n in zip(place, last, strict=True)][::-1], -1)
    return grid_sample(field[None], across[None], "bilinear", "border", align_corners=True)[0]
