"""Standard errors of vectors from windows, by retrieving a known motion (bootstrap).

A window's displacement errs because the images differ (noise, air that changes), because the wind
varies within the window, because paths are curved and because the peak is no Gaussian between whole
pixels. How these add up depends on the method. So the method is applied to an image pair that
differs from the given one only in that its motion is known: image 1, and image 1 moved by the
retrieved wind plus the residual of the given pair. Motion that windows do not resolve is not in
that wind; it shows in the residuals (`unresolved_motion`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce

import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.known_motion import (
    advected,
    at_mid_time,
    of_windows,
    on_pixels,
    origin,
    places,
    read,
)
from lidar_mi.retrieval.correlation.outliers import median_outliers, validated
from lidar_mi.retrieval.correlation.unresolved_motion import Motion, Residuals, unresolved
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.intensity import normalised
from lidar_mi.retrieval.images.noise_map import known_and_weight, variance_of_residual
from lidar_mi.retrieval.images.settings import VOLUME_FILTER, FilterSettings
from lidar_mi.retrieval.images.spline import band_limited, likeliest
from lidar_mi.retrieval.images.windows import (
    Windows,
    averaged,
    linear_weights,
    separable,
    strided,
    working,
)

# Standard deviation of all Gaussian means over the template, and of those that decide whether
# errors are known at all.
_WIDTH, _AROUND = 1.5, 4.5
# Templates by which the residual is shifted along z and y, away from its own texture.
_SEPARATION = 2
# Independent windows of known error within a mean that a variance needs: of the two components of
# five windows, it is known to 45 %.
_FEWEST = 5.0
# Fraction of textured windows in which the known motion must be recovered: a method that fails in
# most of them has errors that the others do not show.
_FOUND = 0.5
# Fraction of textured windows that must be clearly so: else most of them are by chance.
_CLEAR = 0.5
# Least standard error, px: splines do not advect an image more exactly.
_LEAST = 1e-3
# Of the splines that advect an image or a volume.
_FILTERS = {2: FilterSettings(), 3: VOLUME_FILTER}


def bootstrap_covariance(
    images: Sequence[torch.Tensor],
    displacement: Displacement,
    windows: Windows,
    retrieve: Callable[..., Displacement],
    centred: bool,
    textured: torch.Tensor | None = None,
    clear: torch.Tensor | None = None,
    noise: float | torch.Tensor | None = None,
) -> torch.Tensor:
    """Covariance of the displacements' errors, from a further retrieval of a known motion.

    A parametric bootstrap with resampled residuals (Efron & Tibshirani 1993, An Introduction to the
    Bootstrap, ch. 6 and 9). In PIV, the residual of images matched by the measured displacements
    states the random error (Sciacchitano, Wieneke & Scarano 2013, Meas. Sci. Technol. 24, 045302;
    Wieneke 2015, Meas. Sci. Technol. 26, 074002), and synthetic images of known motion state the
    error of the algorithm (Timmins et al. 2012, Exp. Fluids 53, 1133-1147). One pair states both:

    - Its wind d is that of the vectors, outliers replaced, by cubic splines on the pixels.
    - Image 1 after its Wiener filter, the mean of the air given the image, is advected along paths
      in that wind.
    - The residual, image 2 less image 1 so advected, is moved by two templates along both axes,
      scaled to the level at its new place, and added. The level is a mean over Gaussians of 1.5
      templates; where the noise is known of each pixel, the residual's part that is noise follows
      it. So noise and changes keep their size and correlation length, but are independent of the
      texture.

    The vectors retrieved from this pair are d - h (1 - G) d + e, with the mean G over a window, the
    fraction h of least squares, and the random errors e. Vectors lack h (1 - G) d and all finer
    motion, whose covariance is U (`unresolved_motion.unresolved`). The vectors follow part of the
    images' differences, so that the residual, and with it e, is too small by the leverage L. So

        C = L s^2 <e e / s^2> f / (f - 2) + U,

    with the mean < > over a Gaussian of 1.5 templates of the vectors that are valid, and the
    variance s^2 of the noise where that is known of each pixel. With f errors in a mean, normalised
    errors have Student's distribution, of the variance f / (f - 2).

    Errors are unknown where most textured windows around (Gaussian of 4.5 templates) are not
    `clear`, as windows then pass the tests of texture by chance, and where the known motion is
    recovered in less than half of them.

    images (shape (z, y), or (x, z, y) of volumes): the two images.
    displacement: retrieved from them.
    retrieve: (image1, image2, stride=...) -> Displacement, the method with its options.
    centred: windows are deformed, and vectors belong to their centres, not half their displacement
        further on.
    textured (shape windows.count): windows whose errors count, as those of windows without texture
        say nothing of their neighbours; default: all.
    clear (shape windows.count): windows that pass thresholds of texture half as high again;
        default: all.
    noise: standard deviation of the images' noise. Where it is known of each pixel, the residual's
        level and the errors are taken to vary as the residual does with it,
        `noise_map.variance_of_residual`.

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

    neighbour = max(1, round(windows.template / coarse.stride / 2))
    flow, replaced = validated(some(working(displacement.d)), neighbour)
    everywhere = torch.ones_like(replaced)
    textured = everywhere if textured is None else some(textured)
    wind = at_mid_time(flow, coarse, centred)
    mean = of_windows(wind, windows, centred)

    first, second = normalised(images)
    settings = _FILTERS[windows.dims]
    # the Wiener filter smears rims, which would be taken for motion
    spline, sharper = likeliest(first, settings), band_limited([first], settings=settings)[0]
    came_from = origin(wind)
    moved, sharp = (advected(air, came_from) for air in (spline, sharper))
    # air that enters the image is unknown
    compared = second.isfinite() & moved.inside
    residual = torch.where(compared, second - moved.image, 0.0)
    # smoothed, as the variance of few samples is uncertain
    _, weight = known_and_weight(images, noise)
    weight = 1 / variance_of_residual(residual, 1 / weight.to(residual), compared, noise)
    level = averaged(residual.square() * weight, compared, _WIDTH * windows.template) / weight
    level = level.sqrt().clamp(min=torch.finfo(residual.dtype).tiny ** 0.25)
    added = level * (residual / level).roll([_SEPARATION * windows.template] * 2, (-2, -1))
    image = torch.where(second.isfinite(), moved.image + added, torch.nan)
    again = retrieve(first, image, stride=coarse.stride)
    use = _unflagged(again) & ~median_outliers(again.d, 3, neighbour) & textured
    if not bool(use.any()):
        return torch.full_like(torch.stack([displacement.d] * windows.dims), torch.nan)

    vectors, wrong = validated(again.d, neighbour)
    at = places(vectors, coarse, centred)
    point, lacking = read(wind, at), read(wind - mean, at)
    part = lacking[:, use]
    response = ((point - vectors)[:, use] * part).sum() / part.square().sum().clamp(min=1e-30)
    response = response.clamp(0.0, 1.0)
    error = vectors - point + response * lacking
    on = on_pixels(error, coarse)
    valid = textured & ~replaced & ~wrong
    again_moved = advected(spline, origin(at_mid_time(vectors, coarse, centred)))
    finer = unresolved(
        Residuals(
            torch.where(compared, second - sharp.image, 0.0),
            added,
            image.nan_to_num() - again_moved.image,
            level,
            moved.slopes,
            compared & _among_valid(valid, coarse),
        ),
        Motion(wind - mean, float(response), on - of_windows(on, windows, centred)),
        coarse,
        valid,
        _WIDTH * windows.template,
        centred,
        _FEWEST,
    )

    width = _WIDTH * windows.template / coarse.stride
    noise_variance = coarse.of_templates(1 / weight)
    scaled = error / noise_variance.sqrt()
    rows = [[averaged(a * b, use, width) for b in scaled] for a in scaled]
    covariance = finer.leverage * torch.stack([torch.stack(row) for row in rows]) * noise_variance
    number = _windows_per_mean(windows) * averaged(use.to(error), everywhere, width)
    recovered = averaged(use.to(error), textured, _AROUND / _WIDTH * width)
    number = torch.where(recovered < _FOUND, 0.0, number)
    if clear is not None:
        part = averaged(some(clear).to(error), textured, _AROUND / _WIDTH * width)
        number = torch.where(part < _CLEAR, 0.0, number)
    weights = [
        linear_weights(*(frame.centres(axis).to(error) for frame in (coarse, windows)))
        for axis in range(windows.dims)
    ]
    covariance, covariance_finer = (
        separable(part, weights) for part in (covariance, finer.covariance)
    )
    number = separable(number, weights)
    covariance = covariance * _student_factor(number, windows.dims) + covariance_finer
    covariance[:, :, number < _FEWEST] = torch.nan
    least = _LEAST**2 * torch.eye(windows.dims).to(error)
    return covariance + least.reshape(*least.shape, *[1] * windows.dims)


def _unflagged(displacement: Displacement) -> torch.Tensor:
    """Valid vectors, also of windows with some masked pixels."""
    flag = displacement.flag & ~Flag.NON_FINITE_INPUT.value
    return (flag == 0) & displacement.d.isfinite().all(0)


def _among_valid(valid: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Pixels all of whose nearest vectors are valid."""
    weights = []
    for axis, n in enumerate(windows.shape):
        centres, pixels = windows.centres(axis), torch.arange(n)
        inside = (pixels >= centres[0]) & (pixels <= centres[-1])
        weights.append(linear_weights(centres, pixels.to(centres)) * inside[:, None])
    return separable(valid.to(weights[0]), weights) > 1 - 1e-6


def _windows_per_mean(windows: Windows) -> float:
    """Number of separate windows in a local mean, at most those of the image."""
    inside = math.prod(1 + (n - 1) * windows.stride / windows.template for n in windows.count)
    return min(_of_a_mean(windows.dims), inside)


def _of_a_mean(dims: int) -> float:
    return (2 * math.pi) ** (dims / 2) * _WIDTH**dims


def _student_factor(number: torch.Tensor, dims: int) -> torch.Tensor:
    """Variance of errors over the squared standard error estimated from so many windows."""
    degrees = dims * number.clamp(min=_FEWEST / 2)
    return degrees / (degrees - 2)


def enough_windows(windows: Windows) -> bool:
    """Whether images hold as many windows that do not overlap as one local mean."""
    return math.prod(n / windows.template for n in windows.shape) >= _of_a_mean(windows.dims)
