"""The two images of a fit, at every level of blur, and their differences for any parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from kornia.filters import gaussian_blur2d

from lidar_mi.retrieval.images.band_limit import (
    Filter,
    PowerSpectrum,
    best_filter,
    checked_noise,
    power_spectrum,
)
from lidar_mi.retrieval.images.quality import filled
from lidar_mi.retrieval.images.settings import FilterSettings
from lidar_mi.retrieval.images.spline import (
    Spline,
    band_limited,
    filtered_splines,
    mismatch,
    transform_sizes,
)
from lidar_mi.retrieval.vortices.ambient import AmbientWind
from lidar_mi.retrieval.vortices.model import Profile, advected, drift, path_sensitivity, wind
from lidar_mi.retrieval.vortices.pixel_times import ImagedAir, PixelTimes, imaged_air
from lidar_mi.retrieval.vortices.robust_fit import Misfit
from lidar_mi.retrieval.vortices.search import Observations

# Interpolation error of a cubic spline over an image's rms structure.
_INTERPOLATION = 1e-4
# Width (px) of the Gaussian over which the misfit is averaged to the variance at a place.
_LOCAL = 6.0
# Core radii about the cores within which paths are not linear in a change of the pair.
_NEAR_CORES = 2.0
# Gain 1 and offset 0 of image 2 over image 1, no change of either along y and z.
SAME_BRIGHTNESS = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Path(NamedTuple):
    """The path of the air at the pixels at mid-time to one image, tensors (..., z, y).

    steady (10,): the flow in the frame that moves with the pair.
    middle: of the path, in that frame, m.
    place: its end in the image: row and column.
    time: of its end, s; negative to the first image.
    imaged: of pixels with times of their own.
    """

    steady: torch.Tensor
    middle: torch.Tensor
    place: torch.Tensor
    time: torch.Tensor
    imaged: ImagedAir | None


class View(NamedTuple):
    """One image where it shows the air that is at the pixels at mid-time, tensors (z, y).

    place (2, z, y): row and column, px.
    valid: whether that is on the image.
    value, whole: after the filter, and without one.
    jacobian (10, z, y): derivatives of `value` with respect to the parameters of the pair.
    """

    place: torch.Tensor
    valid: torch.Tensor
    value: torch.Tensor
    whole: torch.Tensor
    jacobian: torch.Tensor


@dataclass(frozen=True)
class Images:
    """The two images of a fit; call with parameters for the misfit.

    Parameters are those of the pair and six more: gain and offset of image 2 over image 1, each
    linear in y and z. The unfiltered images are compared, and their difference is
    filtered: filtering them before would remove another part of texture that the vortices have
    sheared, which makes cores 1 % too wide. The derivatives are those of the filtered images. The
    filter that whitens what change adds is applied to both.
    """

    spline: Spline
    whole: Spline
    y: torch.Tensor
    z: torch.Tensor
    first: tuple[float, float]
    spacing: tuple[float, float]
    bad: torch.Tensor
    variance: torch.Tensor
    scatter: torch.Tensor
    dt: float
    profile: Profile
    frozen: bool
    times: PixelTimes | None = None
    whitening: Spline | None = None
    ambient: AmbientWind | None = None

    @cached_property
    def linear(self) -> torch.Tensor:
        """1, y and z (3, ...) at the places, the latter from -1 to 1 over the images."""
        sides = zip(
            (self.y, self.z), self.first, self.spacing, reversed(self.spline.shape), strict=True
        )
        return torch.stack(
            [
                torch.ones_like(self.y),
                *(2 * (p - low) / (step * (n - 1)) - 1 for p, low, step, n in sides),
            ]
        )

    @property
    def passed(self) -> float:
        """Fraction of white noise that the filter passes; 0 where all structure may be change."""
        return (self.whitening or self.spline).passed

    def __call__(self, parameters: torch.Tensor) -> Misfit:
        """Residuals and their derivatives for parameters (16,)."""
        return self.misfit(parameters, self.views(parameters))

    def views(self, parameters: torch.Tensor) -> list["View"]:
        """Both images where the air at the pixels at mid-time is then, for parameters (16,)."""
        return [self.view(number, path) for number, path in enumerate(self.paths(parameters))]

    def misfit(self, parameters: torch.Tensor, views: Sequence["View"]) -> Misfit:
        """The same from the views of both images for these parameters of the pair."""
        gain, offset = self._brightness(parameters)
        valid = views[0].valid & views[1].valid
        if bool(self.bad.any()):
            valid &= ~(self._bad(views[0].place) | self._bad(views[1].place))
        jacobian = valid.new_empty(len(parameters), *valid.shape, dtype=gain.dtype)
        torch.mul(gain, views[0].jacobian, out=jacobian[:10])
        torch.sub(views[1].jacobian, jacobian[:10], out=jacobian[:10])
        torch.mul(-views[0].value, self.linear, out=jacobian[10:13])
        torch.neg(self.linear, out=jacobian[13:16])
        residual = valid * (views[1].whole - gain * views[0].whole - offset)
        # filtered after the difference: shear and a filter of the images do not commute
        if self.whole is not self.spline:
            residual = self.spline.filtered(residual)
        # a mean wind displaces the air by itself times dt
        slope = jacobian[8:10] / self.dt
        misfit = Misfit(residual, jacobian, slope, valid, self.variance, self.scatter)
        return self.whitened(misfit)

    def view(self, number: int, path: "Path") -> "View":
        """Image 0 or 1 at the ends of its path."""
        place, time = path.place, path.time
        (value,), (slope_z,), (slope_y,) = self.spline.only(number).sample(*place[:, None])
        slope = torch.stack([slope_y / self.spacing[0], slope_z / self.spacing[1]])
        if path.imaged is not None:
            slope = path.imaged.along(slope)
        jacobian = path_sensitivity(path.steady, path.middle, slope, time, self.profile)
        torch.mul(slope, time, out=jacobian[8:10])
        whole = value
        if self.whole is not self.spline:
            (whole,) = self.whole.only(number).values(*place[:, None])
        return View(place, self.spline.holds(*place), value, whole, jacobian)

    def paths(self, parameters: torch.Tensor) -> list["Path"]:
        """Of the air at the pixels at mid-time to both images."""
        theta = parameters.to(self.y)[:10]
        moving = torch.zeros_like(theta[:2]) if self.frozen else drift(theta, self.profile)
        # the flow is steady in the frame that moves with the pair
        steady = torch.cat([theta[:8], theta[8:] - moving])
        if self.times is None:
            time = self.y.new_tensor([-self.dt / 2, self.dt / 2])[:, None, None]
            began = wind(steady, self.y, self.z, self.profile)[:, None]
            middle, place = advected(steady, self.y[None], self.z[None], time, self.profile, began)
            place = place + (moving[:, None, None, None] + self._ambient[:, None]) * time
            return [
                Path(steady, middle[:, k], self._pixels(place[:, k]), time[k], None) for k in (0, 1)
            ]
        both = [
            imaged_air(self.times, k, steady, moving, self.y, self.z, self.profile) for k in (0, 1)
        ]
        return [
            Path(
                steady,
                air.middle,
                self._pixels(air.place + self._ambient * air.time),
                air.time,
                air,
            )
            for air in both
        ]

    @cached_property
    def _ambient(self) -> torch.Tensor:
        """Ambient wind (2, z, y) at the places, taken to be uniform over a path."""
        if self.ambient is None:
            return self.y.new_zeros(2, 1, 1)
        return self.ambient.at(self.y, self.z)

    def _pixels(self, place: torch.Tensor) -> torch.Tensor:
        """Row and column (2, ...) of places (2, ...) in m."""
        return torch.stack([(place[k] - self.first[k]) / self.spacing[k] for k in (1, 0)])

    def curved(
        self, known: Misfit, views: Sequence["View"], start: torch.Tensor, end: torch.Tensor
    ) -> torch.Tensor:
        """Change (z, y) of the residuals from start to end, beyond the linear one of a misfit.

        Of the filtered images, near both cores alone: elsewhere displacements are linear in the
        parameters. `known` and `views` are those at the start.
        """
        box = self._near_cores(start)
        near = replace(self, y=self.y[box], z=self.z[box])
        then = [view.value[box] for view in views]
        now = [
            near.spline.only(number).values(*path.place[:, None])[0]
            for number, path in enumerate(near.paths(end))
        ]
        differences = []
        for parameters, (first, second) in ((start, then), (end, now)):
            gain, offset = near._brightness(parameters)
            differences.append(second - gain * first - offset)
        linear = torch.tensordot((end - start).to(self.y), known.jacobian[:, *box], 1)
        curved = torch.zeros_like(known.residual)
        curved[box] = differences[1] - differences[0] - linear
        return known.valid * curved

    def _near_cores(self, parameters: torch.Tensor) -> tuple[slice, slice]:
        """Rows and columns within some core radii of one of the vortices or between them."""
        # core radii are fitted by their logarithms
        reach = _NEAR_CORES * float(parameters[[1, 5]].exp().max())
        box = []
        for places, axis in ((parameters[[3, 7]], 1), (parameters[[2, 6]], 0)):
            low = (float(places.min()) - reach - self.first[axis]) / self.spacing[axis]
            high = (float(places.max()) + reach - self.first[axis]) / self.spacing[axis]
            box.append(slice(max(0, int(low)), max(0, int(high) + 2)))
        return box[0], box[1]

    def _brightness(self, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gain and offset of image 2 over image 1 at the places."""
        parts = (parameters[k : k + 3].to(self.y) for k in (10, 13))
        gain, offset = (torch.tensordot(part, self.linear, 1) for part in parts)
        return gain, offset

    def _bad(self, place: torch.Tensor) -> torch.Tensor:
        """Whether the pixels nearest to places (row, column) are masked."""
        at = [p.round().long().clamp(0, n - 1) for p, n in zip(place, self.bad.shape, strict=True)]
        return self.bad[at[0], at[1]]

    def whitened(self, misfit: Misfit) -> Misfit:
        """A misfit of the images without the whitening filter, after it if there is one."""
        if self.whitening is None:
            return misfit
        # a filter of the images would not commute with their shear
        jacobian = self.whitening.filtered(misfit.jacobian * misfit.valid)
        residual = self.whitening.filtered(misfit.residual)
        slope = jacobian[8:10] / self.dt
        return Misfit(residual, jacobian, slope, misfit.valid, self.variance, self.scatter)

    def weighted(self, misfit: Misfit) -> Misfit:
        """A misfit with the noise of these images."""
        return misfit._replace(variance=self.variance, scatter=self.scatter)

    def at_least(self, power: float) -> "Images":
        """With residuals of at least this mean square, wherever it comes from."""
        ratio = max(1.0, power / float(self.scatter.mean()))
        return replace(self, variance=ratio * self.variance, scatter=ratio * self.scatter)

    def differences(self) -> Observations:
        """Observations of the wind in blurred images: I2 - I1 = -dt u . slope + brightness."""
        rows = (self.z - self.first[1]) / self.spacing[1]
        columns = (self.y - self.first[0]) / self.spacing[0]
        value, slope_z, slope_y = self.spline.sample(
            *(torch.stack([p, p]) for p in (rows, columns))
        )
        slope = torch.stack([slope_y.mean(0) / self.spacing[0], slope_z.mean(0) / self.spacing[1]])
        clean = ~self.bad[rows.round().long(), columns.round().long()]
        strength = slope.square().sum(0)
        # model error of one pixel everywhere
        weight = 1 / (self.scatter + strength * self.spacing[0] * self.spacing[1])
        brightness = torch.cat([value.mean(0) * self.linear, self.linear])
        parts = (self.y, self.z, -self.dt * slope, value[1] - value[0], weight, brightness)
        return Observations(*(part[..., clean] for part in parts))


class Splines(NamedTuple):
    """Splines through images after the filter against white noise and without one.

    With the filter, and the power spectrum that it was chosen by.
    """

    sharp: Spline
    whole: Spline
    filter: Filter
    spectrum: PowerSpectrum


def spectrum_of(images: torch.Tensor) -> PowerSpectrum:
    """Power spectrum of finite images (images, z, y)."""
    settings = FilterSettings()
    return power_spectrum(images, transform_sizes(images.shape[1:], settings), settings)


@dataclass(frozen=True)
class Builder:
    """Builds the images of the levels, from coarse to fine.

    pair (2, z, y): normalised to one mean and contrast.
    bad (z, y): masked pixels.
    z, y: m.
    dt: s.
    level: standard deviation of the noise, in the unit of `pair`; None: from the spectrum.
    map: of each pixel, in any unit.
    profile {"lamb_oseen", "burnham_hallock"}
    telescope: m, as `image_fit.fit_vortices` takes it.
    times: none: -dt / 2 and dt / 2.
    of_first: of the first image, computed without the second one: its filter is that of both.
    ambient: in addition to the wind of the pair.
    """

    pair: torch.Tensor
    bad: torch.Tensor
    z: np.ndarray
    y: np.ndarray
    dt: float
    level: float | None
    map: torch.Tensor | None
    contrast: float
    profile: Profile
    frozen: bool
    telescope: tuple[float, float, float] | None = None
    times: PixelTimes | None = None
    of_first: Splines | None = None
    ambient: AmbientWind | None = None

    @property
    def spacing(self) -> tuple[float, float]:
        """Along y and z, m."""
        along_y, along_z = (
            float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (self.y, self.z)
        )
        return along_y, along_z

    def single(self) -> "Builder":
        """The same in single precision: places to 1e-5 m, brightness to 1e-6 of the contrast."""
        times = self.times and self.times._replace(values=self.times.values.float())
        noise = None if self.map is None else self.map.float()
        return replace(self, pair=self.pair.float(), map=noise, times=times)

    @cached_property
    def splines(self) -> Splines:
        """Of the images."""
        if self.of_first is None:
            return self._splines(self.pair, self.filter(self.level))
        first, second = self.of_first, self._splines(self.pair[1:], self.of_first.filter)
        return first._replace(
            sharp=first.sharp.stacked_with(second.sharp),
            whole=first.whole.stacked_with(second.whole),
        )

    def _splines(self, images: torch.Tensor, chosen: Filter) -> Splines:
        one = torch.ones_like(chosen.gain)
        everything = Filter(one, 0.0, 1.0, 1.0, 1.0, one, one, 0.0)
        sharp, whole = filtered_splines(images, [chosen, everything], FilterSettings())
        return Splines(sharp, whole, chosen, self.spectrum)

    def filter(self, noise: float | None, mismatch: torch.Tensor | None = None) -> Filter:
        """The filter of both images, as `spline.band_limited` chooses it."""
        checked_noise(noise)
        return best_filter(self.spectrum, FilterSettings(), noise, mismatch)

    @cached_property
    def spectrum(self) -> PowerSpectrum:
        """Of both images; of the first one, where its splines were made before."""
        return spectrum_of(self.pair) if self.of_first is None else self.of_first.spectrum

    @property
    def noise(self) -> float:
        """Standard deviation of the white noise, as given or estimated."""
        return self.splines.filter.level

    def __call__(self, blur: float, step: int) -> Images:
        """The images blurred by a Gaussian of so many pixels, at every so many-th pixel."""
        spline, noise = self.splines.sharp, self.noise
        passed = spline.passed
        if blur:
            size = 2 * int(np.ceil(4 * blur)) + 1
            rows, columns = (min(size, 2 * n - 1) for n in self.pair.shape[1:])
            soft = gaussian_blur2d(self.pair[None], (rows, columns), (blur, blur), "replicate")[0]
            # the blur has removed what a filter against noise would remove
            spline = band_limited(list(soft), 0.0)[0]
            spline = spline._replace(coefficients=spline.coefficients.to(self.pair))
            # sum of the squared weights of a Gaussian
            passed = 1 / (4 * np.pi * blur**2)
        places = [
            torch.as_tensor(axis[step // 2 :: step]).to(self.pair) for axis in (self.z, self.y)
        ]
        vertical, lateral = torch.meshgrid(*places, indexing="ij")
        # of the difference of two images
        variance = torch.full_like(lateral, 2 * noise**2)
        if self.map is not None:
            # the filter spreads noise over a few pixels, and with few samples one pixel's estimate
            # is unreliable
            known = torch.nn.functional.avg_pool2d(
                filled(self.map.to(self.pair))[None].square(), 9, 1, 4, count_include_pad=False
            )[0]
            variance = 2 * known[step // 2 :: step, step // 2 :: step] / self.contrast**2
        floor = 2 * _INTERPOLATION**2
        whole = spline if blur or noise == 0 else self.splines.whole
        return Images(
            spline,
            whole,
            lateral,
            vertical,
            (float(self.y[0]), float(self.z[0])),
            self.spacing,
            self.bad,
            variance + floor,
            passed * variance + floor,
            self.dt,
            self.profile,
            self.frozen,
            self.times,
            ambient=self.ambient,
        )

    def with_change(
        self, white: Images, images: Images, misfit: Misfit, flow_variance: float
    ) -> Images:
        """The unblurred images with the noise estimated from the misfit of a fit.

        Air that changes adds differences that are correlated from pixel to pixel. Their power
        spectrum is that of the misfit, and a filter whitens it, except for the fraction that
        the flow's error moves: it differs from place to place as the slopes do. The white noise is
        the lower limit. The filter passes nothing where all structure may be change.
        """
        valid, known = misfit.valid, white.variance
        shape = white.variance / white.variance[valid].mean()
        # the misfit is that behind a filter: divided by what that passes of white noise
        passed = max(images.passed, 1e-6)
        power = (misfit.residual.square() / shape)[valid].mean()
        by_flow = flow_variance * float((misfit.slope.square().sum(0) / shape)[valid].mean())
        level, least = float(power) / passed, float((known / shape)[valid].mean())
        # whitening would take the effect of the flow's departure for stationary change
        fraction = min(1.0, by_flow / max(float(power), passed * least))
        # gain of both filters together, through which the residuals have passed
        gain = white.spline.gain * (1.0 if images.whitening is None else images.whitening.gain)
        before = images.spline._replace(gain=gain)
        # places of more noise count less, so that the spectrum is that of one field
        reduced = valid * misfit.residual / shape.sqrt() / 2
        # the other image's residual is the same with the other sign
        density = mismatch(before, reduced[None], number=2)
        density = density.clamp(min=max(least, fraction * level) / 2)
        level = max(least, level)
        chosen = self.filter((level / 2) ** 0.5, density)
        ratio = torch.where(gain > 0, chosen.gain / white.spline.gain.clamp(min=1e-3), 0.0)
        floor = 2 * _INTERPOLATION**2
        return replace(
            white,
            whitening=white.spline._replace(gain=ratio, passed=chosen.passed, excess=chosen.excess),
            variance=level * shape + floor,
            scatter=chosen.passed * level * shape + floor,
        )
