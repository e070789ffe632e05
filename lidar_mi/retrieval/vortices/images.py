"""The two images of a fit, at every level of blur, and their differences for any parameters."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from kornia.filters import gaussian_blur2d

from lidar_mi.retrieval.velocimetry.band_limit import (
    Filter,
    PowerSpectrum,
    best_filter,
    checked_noise,
    power_spectrum,
)
from lidar_mi.retrieval.velocimetry.quality import filled
from lidar_mi.retrieval.velocimetry.settings import FilterSettings
from lidar_mi.retrieval.velocimetry.warping import (
    Spline,
    band_limited,
    filtered_spline,
    mismatch,
    transform_sizes,
)
from lidar_mi.retrieval.vortices.model import Profile, advected, drift, path_sensitivity, wind
from lidar_mi.retrieval.vortices.pixel_times import PixelTimes, seen
from lidar_mi.retrieval.vortices.robust_fit import Misfit
from lidar_mi.retrieval.vortices.search import Observations

# Interpolation error of a cubic spline over an image's rms structure.
_INTERPOLATION = 1e-4
# Width (px) of the Gaussian over which the misfit is averaged to the variance at a place.
_LOCAL = 6.0
# Gain 1 and offset 0 of image 2 over image 1, no change of either along y and z.
SAME_BRIGHTNESS = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


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

    def __call__(self, parameters: torch.Tensor) -> Misfit:
        """Residuals and their derivatives for parameters (16,)."""
        parameters = parameters.to(self.y)
        theta = parameters[:10]
        gain, offset = (torch.tensordot(parameters[k : k + 3], self.linear, 1) for k in (10, 13))
        half = self.dt / 2
        moving = torch.zeros_like(theta[:2]) if self.frozen else drift(theta, self.profile)
        # the flow is steady in the frame that moves with the pair
        steady = torch.cat([theta[:8], theta[8:] - moving])
        if self.times is None:
            began = wind(steady, self.y, self.z, self.profile)
            middle, place = zip(
                *(
                    advected(steady, self.y, self.z, time, self.profile, began)
                    for time in (-half, half)
                ),
                strict=True,
            )
            shift = moving[:, None, None] * half
            place = [place[0] - shift, place[1] + shift]
            time = -half, half
        else:
            views = [
                seen(self.times, k, steady, moving, self.y, self.z, self.profile) for k in (0, 1)
            ]
            middle, place, time = ([view[part] for view in views] for part in range(3))
        columns, rows = (
            (torch.stack([p[axis] for p in place]) - self.first[axis]) / self.spacing[axis]
            for axis in (0, 1)
        )
        value, slope_z, slope_y = self.spline.sample(rows, columns)
        valid = self.spline.holds(rows, columns).all(0)
        if bool(self.bad.any()):
            nearest = [
                p.round().long().clamp(0, n - 1)
                for p, n in zip((rows, columns), self.bad.shape, strict=True)
            ]
            valid &= ~self.bad[nearest[0], nearest[1]].any(0)
        slope = torch.stack([slope_y / self.spacing[0], slope_z / self.spacing[1]], 1)
        slope[0] *= gain
        if self.times is not None:
            slope = torch.stack([view.along(part) for view, part in zip(views, slope, strict=True)])
        jacobian = value.new_empty(len(parameters), *valid.shape)
        torch.sub(
            path_sensitivity(steady, middle[1], slope[1], time[1], self.profile),
            path_sensitivity(steady, middle[0], slope[0], time[0], self.profile),
            out=jacobian[:10],
        )
        jacobian[8:10] = (
            half * (slope[0] + slope[1])
            if self.times is None
            else time[1] * slope[1] - time[0] * slope[0]
        )
        jacobian[10:13], jacobian[13:16] = -value[0] * self.linear, -self.linear
        if self.whole is not self.spline:
            value = self.whole.values(rows, columns)
        residual = valid * (value[1] - gain * value[0] - offset)
        if self.whole is not self.spline:
            residual = self.spline.filtered(residual)
        slope = jacobian[8:10] / self.dt
        misfit = Misfit(residual, jacobian, slope, valid, self.variance, self.scatter)
        return misfit if self.whitening is None else self.whitened(misfit)

    def whitened(self, misfit: Misfit) -> Misfit:
        """A misfit of the images without the whitening filter, after it."""
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


@dataclass(frozen=True)
class Builder:
    """Builds the images of the levels, from coarse to fine.

    Attributes
    ----------
    pair : torch.Tensor, shape (2, z, y)
        Of one mean and contrast.
    bad : torch.Tensor of bool, shape (z, y)
        Pixels to leave out.
    z, y : ndarray
        m.
    dt : float
        s.
    level : float, optional
        Standard deviation of the noise, in the unit of `pair`; left out, from the spectrum.
    map : torch.Tensor, optional
        Of each pixel, in any unit.
    profile : {"lamb_oseen", "burnham_hallock"}
    frozen : bool
    telescope : (float, float, float), optional
        m, as `image_fit.fit_vortices` takes it.
    times : PixelTimes, optional
        Left out: -dt / 2 and dt / 2.
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

    @property
    def spacing(self) -> tuple[float, float]:
        """Along y and z, m."""
        return tuple(float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (self.y, self.z))

    def single(self) -> "Builder":
        """The same in single precision: places to 1e-5 m, brightness to 1e-6 of the contrast."""
        times = self.times and self.times._replace(values=self.times.values.float())
        noise = None if self.map is None else self.map.float()
        return replace(self, pair=self.pair.float(), map=noise, times=times)

    @cached_property
    def sharp(self) -> tuple[Spline, float]:
        """The images after the filter against white noise, and the noise."""
        chosen = self.filter(self.level)
        return filtered_spline(self.pair, chosen, FilterSettings()), chosen.level

    def filter(self, noise: float | None, mismatch: torch.Tensor | None = None) -> Filter:
        """The filter of both images, as `warping.band_limited` chooses it."""
        checked_noise(noise)
        return best_filter(self.spectrum, FilterSettings(), noise, mismatch)

    @cached_property
    def spectrum(self) -> PowerSpectrum:
        """Of both images."""
        settings = FilterSettings()
        return power_spectrum(self.pair, transform_sizes(self.pair.shape[1:], settings), settings)

    @cached_property
    def unfiltered(self) -> Spline:
        """The images as they are."""
        everything = Filter(torch.ones_like(self.sharp[0].gain), 0.0, 1.0, 1.0, 1.0, 0.0)
        return filtered_spline(self.pair, everything, FilterSettings())

    @property
    def noise(self) -> float:
        """Standard deviation of the white noise, as given or estimated."""
        return self.sharp[1]

    def __call__(self, blur: float, step: int) -> Images:
        """The images blurred by a Gaussian of so many pixels, at every so many-th pixel."""
        spline, noise = self.sharp
        passed = spline.passed
        if blur:
            size = 2 * int(np.ceil(4 * blur)) + 1
            size = tuple(min(size, 2 * n - 1) for n in self.pair.shape[1:])
            soft = gaussian_blur2d(self.pair[None], size, (blur, blur), "replicate")[0]
            spline = band_limited(soft, 0.0)[0]
            spline = spline._replace(coefficients=spline.coefficients.to(self.pair))
            passed = 1 / (4 * np.pi * blur**2)
        places = [
            torch.as_tensor(axis[step // 2 :: step]).to(self.pair) for axis in (self.z, self.y)
        ]
        vertical, lateral = torch.meshgrid(*places, indexing="ij")
        variance = torch.full_like(lateral, 2 * noise**2)
        if self.map is not None:
            # the filter spreads noise over a few pixels, and with few samples one pixel's estimate
            # is unreliable
            known = torch.nn.functional.avg_pool2d(
                filled(self.map.to(self.pair))[None].square(), 9, 1, 4, count_include_pad=False
            )[0]
            variance = 2 * known[step // 2 :: step, step // 2 :: step] / self.contrast**2
        floor = 2 * _INTERPOLATION**2
        whole = spline if blur or noise == 0 else self.unfiltered
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
        passed = max((images.whitening or images.spline).passed, 1e-6)
        power = (misfit.residual.square() / shape)[valid].mean()
        moved = flow_variance * float((misfit.slope.square().sum(0) / shape)[valid].mean())
        level, least = float(power) / passed, float((known / shape)[valid].mean())
        fraction = min(1.0, moved / max(float(power), passed * least))
        gain = white.spline.gain * (1.0 if images.whitening is None else images.whitening.gain)
        before = images.spline._replace(gain=gain)
        rest = valid * misfit.residual / shape.sqrt() / 2
        # the other image's rest is the same with the other sign
        density = mismatch(before, rest[None], number=2)
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
