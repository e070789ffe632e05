"""The noise of images by place and wavenumber, from the residuals of a flow's fit."""

import numpy as np
import torch

from lidar_mi.retrieval.flow.change import displaced, of_structure, unexplained
from lidar_mi.retrieval.flow.coherent_change import (
    CORRELATED_AREA,
    ResidualOperator,
    mean_square_displacement,
)
from lidar_mi.retrieval.flow.likelihood import Images, Linear
from lidar_mi.retrieval.images.band_limit import LEAST_REDUCTION, flat_if_nearly, wavenumbers
from lidar_mi.retrieval.images.intensity import rms
from lidar_mi.retrieval.images.spline import Spline, band_limited, filter_of, mismatch, spectrum_of
from lidar_mi.retrieval.images.windows import averaged

# Misfit over white noise estimated from spectra below which that is not noise: of white noise the
# flow absorbs a fifth at most.
_OVERSTATED = 2 / 3
# Noise that is not given is taken from the misfit down to this fraction of the images' rms: finer
# differences, of smoke's interpolation and of what its rims ring, are no noise.
_FINEST = 0.004
# Least variance of the noise over its mean, by place and by wavenumber, where it is not given.
_LEAST_LOCAL, _LEAST_DENSITY = 0.01, 0.003
# The same where it is given.
_LEAST_GIVEN = 0.5
# Fraction of the differences of images with a noise that is given, by blur in strained air, above
# which their misfit is not whitened.
_BLURRED = 0.25
# Iterations over the noise by place and by wavenumber.
_ROUNDS = 3


def with_local_noise(
    images: Images,
    linear: Linear,
    width: float,
    coloured: bool,
    knots: float,
    strain: float = 0.0,
    residual_of: ResidualOperator | None = None,
) -> Images:
    """The images with the noise estimated from their misfit at each place and wavenumber.

    Warped images differ by more than their noise where structure moves out of the plane, is
    undersampled, or moves on scales smaller than the splines'. A noise that is given is the lower
    limit. One that was not given is of the spectra, where fine texture looks like noise: their
    misfit takes its place if it is clearly less. In a plane it then does so at each place and
    wavenumber, down to 0.4 % of the images' rms. What is noise at a place depends on the waves that
    the filter passes, and the filter on the weights of the places: both are estimated iteratively.

    Two kinds of change have smaller residuals than noise has. In each wavenumber a lower limit is
    the out-of-plane motion that the waves shorter than two `knots` (px) show: the flow absorbs part
    of the misfit of longer ones. And structure that is not advected can move as a whole, see
    `coherent_change.mean_square_displacement`.

    Parameters
    ----------
    images : Images
    linear : Linear
        Of the images, about the flow.
    width : float
        Standard deviation of the Gaussian mean of the misfit, px.
    coloured : bool
        Whether the misfit is resolved by wavenumber.
    knots : float
        Spacing of the flow's knots, px.
    strain : float
        Mean square of the flow's strain in dt, in a plane along its axes; blur that is not known
        makes images differ by it.
    residual_of : callable, optional
        Residual of a difference of images in a plane after the fit, see
        `coherent_change.residual_operator`. None of volumes.
    """
    again, overstated = images.noise_updated, False
    coherent = images.coherent
    if residual_of is not None:
        square = mean_square_displacement(images, linear, residual_of)
        coherent = max(coherent, square * CORRELATED_AREA)
    residual = (linear.warped - linear.warped.mean(0)) * linear.valid
    slope = linear.slope * linear.valid
    power, steep = _weighted(images, images.spline.passed, residual, slope)
    if not images.noise_known and linear.valid.any():
        whole = float(power[linear.valid].sum() / steep[linear.valid].sum())
        overstated = whole < _OVERSTATED * images.white**2
        if overstated:
            images = images._replace(white=whole**0.5)
    floor = images.white**2
    least, least_density, rounds = _LEAST_GIVEN, _LEAST_GIVEN, 1
    if overstated and residual_of is not None:
        floor = max(min(floor, (_FINEST * rms(images.stack)) ** 2), images.known_noise**2)
        # where air changes, what differs by less than the mean has been absorbed by the flow
        least, least_density, rounds = 1.0 if again else _LEAST_LOCAL, _LEAST_DENSITY, _ROUNDS
    for to_come in reversed(range(rounds)):
        local = averaged(power, linear.valid, width) / averaged(steep, linear.valid, width)
        mean = float(local[linear.valid].mean()) if linear.valid.any() else 0.0
        level = max(floor, mean, 1e-30)
        weight = images.weight * (level / local.clamp(min=max(floor, least * level)))
        density: torch.Tensor | None = None
        if coloured:
            least_of_wave = max(floor, least_density * level)
            density = mismatch(images.spline, residual * weight.sqrt()).clamp(min=least_of_wave)
        if to_come:
            chosen = filter_of(
                images.stack,
                level**0.5,
                density,
                weight.sqrt(),
                images.blur,
                images.spline.settings,
            )
            parts = (_refiltered(images.spline, chosen.gain, part) for part in (residual, slope))
            power, steep = _weighted(
                images, chosen.passed, *(part * linear.valid for part in parts)
            )
    square = 0.0
    if density is not None:
        structure = of_structure(images.spline, images.stack, images.white)
        found = mismatch(images.spline, residual)
        square, blurred = unexplained(images.spline, found, structure, strain, knots)
        wave = wavenumbers(density, images.spline.shape)
        density = torch.maximum(density, square * displaced(wave, structure))
        if not (square or coherent):
            settings = images.spline.settings
            spectrum = spectrum_of(images.stack, weight.sqrt(), settings)
            # a filter that is not flat adds to what blur in strain makes
            reduction = np.inf if images.noise_known and blurred > _BLURRED else LEAST_REDUCTION
            density = flat_if_nearly(spectrum, density, settings.threshold, reduction)
    spline, level = band_limited(
        images.stack, level**0.5, density, weight.sqrt(), images.blur, images.spline.settings
    )
    return images._replace(
        spline=spline,
        noise=level,
        weight=weight,
        noise_updated=True,
        out_of_plane=square,
        coherent=coherent,
    )


def _weighted(
    images: Images, passed: float, residual: torch.Tensor, slope: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Variance of the noise times the squared slopes at each pixel, and the squared slopes.

    Of fields after a filter that lets pass this fraction of the variance of white noise.
    What counts is the misfit where slopes are steep, and there it is largest (White 1980,
    Econometrica 48, 817-838).
    """
    free = (len(residual) - 1) * max(passed, 1e-6)
    steep = slope.square().sum(0)
    steep = steep + 1e-3 * steep.mean() + 1e-30
    return residual.square().sum(0) * images.weight * steep / free, steep


def _refiltered(before: Spline, gain: torch.Tensor, fields: torch.Tensor) -> torch.Tensor:
    """Fields of images after one filter, as they would be after another of this gain."""
    most = float(before.gain.max())
    ratio = torch.where(before.gain > 1e-3 * most, gain / before.gain.clamp(min=1e-30), 0.0)
    return before._replace(gain=ratio).filtered(fields)
