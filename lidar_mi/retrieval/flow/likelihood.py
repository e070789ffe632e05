"""Likelihood of a flow, linearised: images or volumes warped to mid-time, equal in brightness."""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.band_limit import Filter
from lidar_mi.retrieval.images.intensity import normalised, normalised_intensity, rms
from lidar_mi.retrieval.images.noise_map import known_and_weight
from lidar_mi.retrieval.images.quality import misfit_variance
from lidar_mi.retrieval.images.spline import (
    Spline,
    filter_of,
    finite,
    nearest,
    splines_of_values_and_slopes,
)
from lidar_mi.retrieval.images.windows import averaged

# Interpolation error of the splines over an image's rms structure: the least noise assumed.
_INTERPOLATION = 1e-5
# A noise that is given and below this fraction of that of the spectra (of the variances) is only a
# lower limit: what differs are the air and what splines cannot interpolate.
_LEAST_KNOWN = 0.1
# Width of the means that separate texture from noise, in cells between knots: at 0.8 too few
# pixels, at 3 the rim of smoke counts as texture next to it.
_FRACTION_WIDTH = 1.5


class Images(NamedTuple):
    """The images that the flow is fitted to, and their noise.

    spline: of the images for their differences, whose noise is white.
    smooth: of the images for their slopes, see `band_limit.Filter`.
    usable (images, ...): away from non-finite pixels.
    time (images,): from mid-time, in units of dt.
    noise: standard deviation of the images' white noise.
    weight (shape of an image): inverse-variance weight: mean variance of the noise over its own at
        each pixel.
    given_weight (shape of an image): the same by the noise as given.
    stack (images, ...): the images, with normalised intensity.
    blur: standard deviation of the Gaussian that blurred the images, px.
    known_noise: the noise that was given; 0 if none was.
    chosen: of the images.
    noise_known: whether that is the noise; else it is a lower limit.
    noise_updated: whether noise and weight are those of `components.differences`.
    all_usable: whether all pixels are usable.
    """

    spline: Spline
    smooth: Spline
    usable: torch.Tensor
    time: torch.Tensor
    noise: float
    weight: torch.Tensor
    given_weight: torch.Tensor
    stack: torch.Tensor
    blur: float
    known_noise: float
    chosen: Filter
    noise_known: bool = True
    noise_updated: bool = False
    all_usable: bool = False

    def single(self) -> "Images":
        """The same to be warped in single precision: places to 1e-5 px."""
        spline, smooth = (
            one._replace(coefficients=one.coefficients.float())
            for one in (self.spline, self.smooth)
        )
        return self._replace(
            spline=spline, smooth=smooth, time=self.time.float(), weight=self.weight.float()
        )

    def only(self, number: int) -> "Images":
        """With the splines of one of the images."""
        return self._replace(spline=self.spline.only(number), smooth=self.smooth.only(number))

    def filtered(self, chosen: Filter) -> "Images":
        """The images after another filter, with its noise."""
        stack = finite(self.stack)
        chosen = chosen.to(stack)
        spline, smooth = splines_of_values_and_slopes(stack, chosen, self.spline.settings)
        return self._replace(spline=spline, smooth=smooth, noise=chosen.level, chosen=chosen)

    def sample(self, *places: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Values, smooth values and their slopes at places (images, ...)."""
        return self.spline.values(*places), *self.smooth.sample(*places)


class Linear(NamedTuple):
    """The log-likelihood linearised about a flow.

    slope (components, ...): the likeliest slopes of the air, mean of the warped images.
    gradient (components, ...): of the log-likelihood with respect to the flow at each pixel.
    weight: of the products of slopes in the information.
    variance (): of the noise.
    smooth (images, ...): the images at mid-time, equal in brightness, after the filter of their
        slopes.
    warped (images, ...): the same after that of their differences.
    valid: where all of them are.
    regular: factor by which residuals count less in the fit, 1 but for outliers (Huber).
    """

    slope: torch.Tensor
    gradient: torch.Tensor
    weight: torch.Tensor
    variance: float | torch.Tensor
    smooth: torch.Tensor
    warped: torch.Tensor
    valid: torch.Tensor
    regular: torch.Tensor


def prepared(
    stack: Sequence[torch.Tensor],
    noise: float | torch.Tensor | None,
    blur: float,
    settings: VariationalSettings,
) -> Images:
    """The images, normalised and band-limited, with the noise as given or estimated."""
    known_at, weight = known_and_weight(stack, noise, settings.noise_width)
    images = normalised(stack)
    known_noise = 0.0 if noise is None else rms(noise)
    of_spectra = filter_of(images, None, None, weight.sqrt(), blur, settings.filter).level
    noise_known = known_noise**2 > _LEAST_KNOWN * of_spectra**2
    chosen = filter_of(
        images,
        known_noise if noise_known else of_spectra,
        weight=weight.sqrt(),
        blur=blur,
        settings=settings.filter,
    )
    spline, smooth = splines_of_values_and_slopes(finite(images), chosen, settings.filter)
    level = max(chosen.level, _INTERPOLATION * rms(images))
    time = torch.arange(len(stack), dtype=weight.dtype, device=weight.device)
    return Images(
        spline,
        smooth,
        known_at,
        # mid-time is that of the whole burst
        time - time.mean(),
        level,
        weight,
        weight,
        images,
        blur,
        known_noise,
        chosen,
        noise_known,
        all_usable=bool(known_at.all()),
    )


def linearised(
    images: Images, mesh: Mesh, coefficients: torch.Tensor, settings: VariationalSettings
) -> Linear:
    """The log-likelihood about a flow; `mesh` is that of the pixels."""
    places = path(mesh, coefficients, images.time, settings.path_order)
    return linearised_there(images, mesh, places, images.sample(*places), settings)


def linearised_there(
    images: Images,
    mesh: Mesh,
    places: torch.Tensor,
    sampled: Sequence[torch.Tensor],
    settings: VariationalSettings,
) -> Linear:
    """`linearised`, with what `Images.sample` gives at the places of `path`.

    Differences of the images times their slopes inform the flow. Noise is in both. The slopes are
    those of the air that are expected from the images (Wiener), so that the information is their
    square over the variance of the differences' white noise, for waves of every length.
    """
    value, smooth, *slopes = sampled
    # numbers stay on the device: to wait for one takes as long there as to compute with it
    valid = images.spline.holds(*places).all(0)
    if not images.all_usable:
        valid = valid & nearest(images.usable, places).all(0)
    # over air that is in all images: bright air that enters would change the brightness of all
    smooth, _ = normalised_intensity(smooth, images.weight * valid)
    value, gain = normalised_intensity(value, images.weight * valid)
    slope = torch.stack([(gain * part).mean(0) for part in slopes])
    residual = (value - value.mean(0)) * images.weight.sqrt()
    passed = max(images.spline.passed, 1e-6)
    misfit = residual.square().sum(0)
    # what no flow explains counts as noise: images are never taken to be better than they fit
    variance = misfit.new_full((), max(images.noise**2, 1e-30))
    if not images.noise_updated:
        variance = variance.maximum(misfit_variance(misfit, valid, len(value)) / passed)
    off = (misfit / ((len(value) - 1) * passed * variance)).sqrt()
    # beyond `robust` standard deviations residuals enter linearly (Huber)
    regular = settings.robust / off.clamp(min=settings.robust)
    weight = images.weight * regular * valid
    time = images.time.reshape(-1, *[1] * mesh.dims)
    # an image moves by its time times the flow: the derivative weights it by that
    difference = (time * (value - value.mean(0))).sum(0)
    informed = images.spline.efficiency * weight / variance
    slope = slope * _fraction_of_texture(images, slope, valid, mesh)
    gradient = -informed * difference * slope
    information = images.time.square().sum() * informed
    return Linear(slope, gradient, information, variance, smooth, value, valid, regular)


def information_of_first(
    images: Images, mesh: Mesh, places: torch.Tensor, sampled: Sequence[torch.Tensor], number: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Information of images in a plane on a flow, as far as the first of them shows it.

    Of the pixels' mesh, and ``number`` images; ``sampled`` are value and slopes (1, z, y) of the
    first one at its ``places`` by `path`. Slope and information are those of `Linear`, of texture
    that all images show alike. Outliers are not known.
    """
    _, _, *slopes = sampled
    # as of the image warped to mid-time: the means of all images' own slopes need no turning
    turned = torch.gradient(places[:, 0], dim=(1, 2))
    slope = torch.stack([(torch.cat(slopes) * along).sum(0) for along in turned])
    valid = nearest(images.usable, places[:, :1])[0] & images.spline.holds(*places).all(0)
    # one image has more noise than the mean of them
    slope = slope * _fraction_of_texture(images, slope, valid, mesh, number)
    informed = images.spline.efficiency * images.weight * valid / max(images.noise**2, 1e-30)
    return slope, images.time.square().sum() * informed


def information_near(slope: torch.Tensor, information: torch.Tensor, mesh: Mesh) -> torch.Tensor:
    """Information on both components about each pixel: the mean that the flow's splines see."""
    of_both = information * slope.square().sum(0)
    return averaged(of_both, torch.ones_like(of_both, dtype=torch.bool), _width(mesh))


def _width(mesh: Mesh) -> float:
    axis = mesh.axes[0]
    return _FRACTION_WIDTH * (axis.size - 1) / axis.cells


def _fraction_of_texture(
    images: Images, slope: torch.Tensor, valid: torch.Tensor, mesh: Mesh, more: float = 1.0
) -> torch.Tensor:
    """Regression of the air's slopes on those of the images at each pixel, 1 in its mean.

    Noise has slopes too, and next to bright smoke there are no others. The Wiener filter of the
    slopes makes the regression 1 where texture is as strong as in the mean of the image.
    """
    power = averaged(slope.square().sum(0), valid, _width(mesh)).clamp(min=1e-30)
    noisy = more * images.smooth.noisy_slopes / images.weight
    fraction = (1 - noisy / power).clamp(min=0.0)
    power = power * valid
    return fraction / ((fraction * power).sum() / power.sum().clamp(min=1e-30)).clamp(min=1e-6)


def path(mesh: Mesh, coefficients: torch.Tensor, time: torch.Tensor, terms: int) -> torch.Tensor:
    """Position at other times of the air at the pixels at mid-time, (components, images, ...), px.

    Lie series x + sum t^k / k! (u . grad)^(k - 1) u for a steady wind: with six terms, where air
    rotates by an angle a in t, the position error is a^7 / 5040 of the radius.
    """
    flow = mesh.field(coefficients)
    time = time.reshape(-1, *[1] * mesh.dims)
    term = flow
    change = time * term[:, None]
    for k in range(2, terms + 1):
        along: Sequence[torch.Tensor] = (
            mesh.slopes(coefficients)
            # slopes of the splines are exact; in the small further terms differences suffice
            if k == 2
            else torch.gradient(term, dim=tuple(range(1, term.ndim)))
        )
        term = reduce(torch.add, [u * part for u, part in zip(flow, along, strict=True)])
        change = change + time**k / math.factorial(k) * term[:, None]
    for axis, place in enumerate(mesh.places):
        change[axis] += place.reshape(-1, *[1] * (mesh.dims - 1 - axis))
    return change
