"""A pair of wake vortices from two images, or from wind vectors: the model that explains them best.

No vector is needed on the way: the whole image tells of the ten parameters at once, so this works
where the texture is too weak for any local method, and as well as the noise allows elsewhere.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import xarray as xr
from kornia.filters import gaussian_blur2d

from lidar_mi.atmosphere.vortex import Vortex
from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_pair, on_device, positive
from lidar_mi.retrieval.quantity import Quantity
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.quality import Flag, filled, non_finite
from lidar_mi.retrieval.velocimetry.warping import Spline, band_limited, levelled
from lidar_mi.retrieval.velocimetry.windows import Windows, image_pair
from lidar_mi.retrieval.vortices.flow_error import FlowError, flow_error, mean_length, spread_of
from lidar_mi.retrieval.vortices.model import (
    PROFILES,
    Profile,
    carried,
    drift,
    path_sensitivity,
    sensitivity,
    turning,
    wind,
)
from lidar_mi.retrieval.vortices.robust_fit import Misfit, Solution, fit
from lidar_mi.retrieval.vortices.search import Observations, starting_points

# Coarse to fine: standard deviation of the blur and step between the pixels used, px.
_LEVELS = ((3.0, 4), (1.5, 2), (0.0, 1))
_STARTS = 3
# A cubic spline misses about so much of an image's rms structure.
_INTERPOLATION = 1e-4
# What the flow may be off at first (px); later it is estimated.
_FIRST_FLOW_ERROR = 0.1
# Lags (px) over which the noise of band-limited images correlates.
_NOISE_LAGS = 4.0
# A fit has converged when its steps get smaller than so many standard errors, squared.
_TOLERANCE = 0.03
# A fit is refused below these: circulation over its standard error, correlation of the images.
_SIGNIFICANCE = 5.0
_MATCH = 0.5


@dataclass(frozen=True, eq=False)
class VortexPairFit:
    """Two vortices in a mean wind, at mid-time.

    Attributes
    ----------
    parameters : ndarray, shape (10,)
        In the order of `vortex_model.PARAMETERS`; NaN where there is no fit at all. Port is the
        vortex that turns from +y towards +z (circulation > 0).
    covariance : ndarray, shape (10, 10)
        Of the parameters: from the noise and from the flow's departure from the model.
    profile : {"lamb_oseen", "burnham_hallock"}
        To which circulation and core radius belong: the same data give different radii.
    chi2 : float
        Mean square of the residuals over that of the noise; 1 where the model is all there is.
        NaN where no noise is known.
    correlation : float
        Of image 1 and image 2, each carried to mid-time by the fit; of fits to vectors the share
        of their variance that is explained.
    flow_error : float
        Rms of each component of the wind that the model misses, m s^-1; as far as the residuals
        show it.
    flow_error_length : float
        Over which it correlates, m.
    success : bool
    reasons : tuple of str
        Why not.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    profile: Profile
    chi2: float
    correlation: float
    flow_error: float
    flow_error_length: float
    reasons: tuple[str, ...] = ()

    @property
    def success(self) -> bool:
        return not self.reasons

    @property
    def port(self) -> Vortex:
        return self._vortex(0)

    @property
    def starboard(self) -> Vortex:
        return self._vortex(4)

    @property
    def mean_wind(self) -> tuple[float, float]:
        """v and w of the air the pair is in, m s^-1."""
        return float(self.parameters[8]), float(self.parameters[9])

    def _vortex(self, first: int) -> Vortex:
        circulation, log_radius, y, z = self.parameters[first : first + 4]
        return Vortex(
            float(circulation), float(np.exp(log_radius)), float(y), float(z), self.profile
        )

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """What wake vortices are described by, with standard errors to first order.

        circulation (Gamma, far from the core) and circulation_5_15 (Gamma of the single vortex,
        mean over radii from 5 to 15 m), core_radius (of the largest swirl), y, z of port and
        starboard; separation b_0, centre_y, centre_z, descent_speed w_0 = Gamma/(2 pi b_0) with
        the mean circulation, time_scale t_0 = b_0/w_0; mean_v, mean_w; drift_v and drift_w, the
        velocity of the pair, which the mean wind and its own make together.
        """
        theta = torch.as_tensor(self.parameters)

        def derived(theta):
            return torch.stack(list(_derived(theta, self.profile).values()))

        values = _derived(theta, self.profile)
        slope = torch.autograd.functional.jacobian(derived, theta).numpy()
        spread = np.sqrt(np.einsum("ij,jk,ik->i", slope, self.covariance, slope))
        return {
            name: Quantity(float(value), float(error), *MEANING[name])
            for (name, value), error in zip(values.items(), spread)
        }

    def after(self, seconds: float) -> "VortexPairFit":
        """The pair as it drifts on, with the errors that grow on the way.

        The vortices keep their circulation, core radius and distance: good for a fraction of the
        time in which the pair descends by its separation.
        """

        def moved(theta):
            return theta + seconds * drift(theta, self.profile) @ _CENTRES.to(theta)

        theta = torch.as_tensor(self.parameters)
        slope = torch.autograd.functional.jacobian(moved, theta).numpy()
        covariance = slope @ self.covariance @ slope.T
        return replace(self, parameters=moved(theta).numpy(), covariance=covariance)

    def wind(self, y, z) -> xr.Dataset:
        """The wind of the fit anywhere, at mid-time; `after` gives that of a later one.

        Parameters
        ----------
        y, z : array_like
            m; they broadcast. One-dimensional DataArrays or arrays of the same shape give values
            place by place; use ``y[None, :]`` and ``z[:, None]`` for a grid.

        Returns
        -------
        Dataset
            `v`, `w`, `v_stderr`, `w_stderr` (m s^-1) and `vw_correlation`, dims (row, column) or as
            the arrays have. The errors hold those of the parameters and the flow's error.
        """
        y, z = np.broadcast_arrays(np.asarray(y, dtype=float), np.asarray(z, dtype=float))
        values, covariance = self.wind_and_covariance(y, z)
        stderr = np.sqrt(covariance[:2])
        both = stderr[0] * stderr[1]
        dims = [f"dim_{k}" for k in range(y.ndim)]
        fields = {
            "v": values[0],
            "w": values[1],
            "v_stderr": stderr[0],
            "w_stderr": stderr[1],
            "vw_correlation": np.divide(
                covariance[2], both, out=np.zeros_like(both), where=both > 0
            ),
        }
        return xr.Dataset(
            {
                name: (dims, field, {"units": "1" if "correlation" in name else "m s-1"})
                for name, field in fields.items()
            },
            coords={"y": (dims, y, {"units": "m"}), "z": (dims, z, {"units": "m"})},
        )

    def wind_and_covariance(self, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """v, w (2, ...) at places and their covariance vv, ww, vw (3, ...)."""
        y, z = np.broadcast_arrays(y, z)
        theta = torch.as_tensor(self.parameters)
        places = [torch.as_tensor(np.array(axis, dtype=float)) for axis in (y, z)]
        unit = torch.eye(2, dtype=theta.dtype)
        slope = [
            sensitivity(theta, *places, direction.view(2, *[1] * places[0].ndim), self.profile)
            for direction in unit
        ]
        covariance = torch.as_tensor(self.covariance)
        v, w = (torch.tensordot(covariance, part, 1) for part in slope)
        own = self.flow_error**2
        spread = torch.stack(
            [(v * slope[0]).sum(0) + own, (w * slope[1]).sum(0) + own, (v * slope[1]).sum(0)]
        )
        return wind(theta, *places, self.profile).numpy(), spread.numpy()


# What a drift along y and along z adds to the parameters.
_CENTRES = torch.zeros(2, 10)
_CENTRES[0, [2, 6]] = _CENTRES[1, [3, 7]] = 1.0

MEANING = {
    f"{side}_{name}": (units, f"{text} of the {side} vortex")
    for side in ("port", "starboard")
    for name, units, text in (
        ("circulation", "m2 s-1", "circulation"),
        ("circulation_5_15", "m2 s-1", "circulation, mean over radii from 5 to 15 m,"),
        ("core_radius", "m", "radius of the largest swirl"),
        ("y", "m", "y of the centre"),
        ("z", "m", "z of the centre"),
    )
} | {
    "separation": ("m", "distance of the vortices, b0"),
    "centre_y": ("m", "y half way between the vortices"),
    "centre_z": ("m", "z half way between the vortices"),
    "descent_speed": ("m s-1", "descent speed of the pair, w0 = Gamma / (2 pi b0)"),
    "time_scale": ("s", "time in which the pair descends by its separation, t0 = b0 / w0"),
    "mean_v": ("m s-1", "mean wind along y"),
    "mean_w": ("m s-1", "mean wind along z"),
    "drift_v": ("m s-1", "velocity of the pair along y, mean wind included"),
    "drift_w": ("m s-1", "velocity of the pair along z, mean wind included"),
}
"""Units and long name of every quantity of a pair."""


def circulation_5_15(circulation, core_radius, profile: Profile = "lamb_oseen"):
    """Circulation of a vortex averaged over radii from 5 to 15 m, as lidars report it, m^2 s^-1."""
    circulation = torch.as_tensor(circulation, dtype=torch.float64)
    core_radius = torch.as_tensor(core_radius, dtype=torch.float64)
    radius = torch.linspace(5, 15, 101, dtype=torch.float64)
    s = (radius / core_radius) ** 2
    return circulation * torch.trapezoid(turning(s, profile)[0] * s, radius) / 10


def _derived(theta: torch.Tensor, profile: Profile) -> dict[str, torch.Tensor]:
    values = {}
    for side, first in (("port", 0), ("starboard", 4)):
        circulation, radius = theta[first], theta[first + 1].exp()
        values[f"{side}_circulation"] = circulation
        values[f"{side}_circulation_5_15"] = circulation_5_15(circulation, radius, profile)
        values[f"{side}_core_radius"] = radius
        values[f"{side}_y"], values[f"{side}_z"] = theta[first + 2], theta[first + 3]
    separation = torch.hypot(theta[2] - theta[6], theta[3] - theta[7])
    speed = (theta[0] - theta[4]) / 2 / (2 * torch.pi * separation)
    values["separation"] = separation
    values["centre_y"], values["centre_z"] = (theta[2] + theta[6]) / 2, (theta[3] + theta[7]) / 2
    values["descent_speed"], values["time_scale"] = speed, separation / speed
    values["mean_v"], values["mean_w"] = theta[8], theta[9]
    values["drift_v"], values["drift_w"] = drift(theta, profile)
    return values


# --- from images


@dataclass(frozen=True)
class _Images:
    """Two images as the fit reads them; call with parameters for the misfit.

    Parameters are those of the pair and two more, gain and offset of image 2 over image 1. The
    images are compared whole, and their difference is filtered: a filter before would take
    another part from texture that the vortices have sheared, which makes cores 1 % too wide. The
    derivatives are those of the filtered images.
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

    def __call__(self, parameters: torch.Tensor) -> Misfit:
        theta, gain, offset = parameters[:10], parameters[10], parameters[11]
        half = self.dt / 2
        moving = torch.zeros_like(theta[:2]) if self.frozen else drift(theta, self.profile)
        # the flow stands still in the frame that moves with the pair
        steady = torch.cat([theta[:8], theta[8:] - moving])
        middle, place = zip(
            *(carried(steady, self.y, self.z, time, self.profile) for time in (-half, half))
        )
        shift = moving[:, None, None] * half
        place = [place[0] - shift, place[1] + shift]
        columns, rows = (
            (torch.stack([p[axis] for p in place]) - self.first[axis]) / self.spacing[axis]
            for axis in (0, 1)
        )
        value, slope_z, slope_y = self.spline.sample(rows, columns)
        seen = self.spline.holds(rows, columns).all(0)
        if bool(self.bad.any()):
            nearest = [
                p.round().long().clamp(0, n - 1) for p, n in zip((rows, columns), self.bad.shape)
            ]
            seen &= ~self.bad[nearest[0], nearest[1]].any(0)
        slope = torch.stack([slope_y / self.spacing[0], slope_z / self.spacing[1]], 1)
        slope[0] *= gain
        jacobian = value.new_empty(12, *seen.shape)
        torch.sub(
            path_sensitivity(steady, middle[1], slope[1], half, self.profile),
            path_sensitivity(steady, middle[0], slope[0], -half, self.profile),
            out=jacobian[:10],
        )
        jacobian[8:10] = half * (slope[0] + slope[1])
        jacobian[10], jacobian[11] = -value[0], -1
        if self.whole is not self.spline:
            value, _, _ = self.whole.sample(rows, columns)
        residual = seen * (value[1] - gain * value[0] - offset)
        if self.whole is not self.spline:
            residual = self.spline.filtered(residual)
        return Misfit(residual, jacobian, slope.mean(0), seen, self.variance, self.scatter)


def fit_vortices(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray | None = None,
    profile: Profile = "lamb_oseen",
    *,
    frozen: bool = False,
    device: str | torch.device = "cpu",
) -> VortexPairFit:
    """Two vortices and a mean wind that carry image 1 into image 2.

    Every pixel is followed half a dt back and half a dt on along its curved path; there the images
    must agree, but for a gain and an offset. The squares of their difference are minimised, each
    weighted by the noise and by what the flow's departure from the model makes of the image's
    slope; the departure is estimated from the residuals of the same fit. The start is the best
    of all pairs of places (see `vortex_search`), no guess is needed.

    Parameters
    ----------
    image1, image2 : DataArray, dims (z, y)
        On one grid, as `lidar_mi.retrieval.velocimetry.wind.retrieve_wind` takes them. NaN pixels are left out.
    dt : float
        s.
    noise : float or DataArray, optional
        Standard deviation of each image's white noise, in image 1's unit; of pixels where it is an
        image. Left out: from the images' spectra.
    profile : {"lamb_oseen", "burnham_hallock"}
    frozen : bool
        The vortices stay where they are during dt. Default: they drift with the mean wind and each
        other's.
    device : str or torch.device

    Returns
    -------
    VortexPairFit
        Look at `success` and `reasons` first.

    Raises
    ------
    InputError
        Images on different or unsuitable grids, a parameter out of its range.
    """
    dt = positive("dt", dt)
    image1, image2, noise = checked_pair(image1, image2, noise)
    _check_profile(profile)
    axes = [image1[name].values.astype(float) for name in ("z", "y")]
    pixels = [on_device(image, device) for image in (image1, image2)]
    if isinstance(noise, xr.DataArray):
        noise = on_device(noise, device)
    return fit_pixels(*pixels, *axes, dt, noise, profile, frozen)


def fit_pixels(
    image1: torch.Tensor,
    image2: torch.Tensor,
    z: np.ndarray,
    y: np.ndarray,
    dt: float,
    noise: float | torch.Tensor | None,
    profile: Profile,
    frozen: bool = False,
) -> VortexPairFit:
    """`fit_vortices` on tensors (z, y) and axes in m."""
    finite = torch.isfinite(image1) & torch.isfinite(image2)
    if float(finite.double().mean()) < 0.5:
        return _no_fit(profile, f"{float(finite.double().mean()):.0%} of the pixels are finite")
    # in units of image 1's own structure, so that no constant depends on the images' unit
    pair = levelled([image1.double(), image2.double()])
    contrast = pair[0][finite].std()
    scale = filled(image1.double()).abs().max()
    if not bool(contrast > 1e-9 * scale) or not bool(pair[1][finite].std() > 0):
        return _no_fit(profile, "an image is constant")
    pair = pair / contrast
    if isinstance(noise, torch.Tensor):
        noise = noise.double() * _understated(noise / contrast, pair)
    level = _typical(noise, pair[0].square())
    if level is not None:
        level /= float(contrast)
    bad = torch.nn.functional.max_pool2d((~finite)[None].double(), 5, 1, 2)[0] > 0
    make = _Builder(pair, bad, z, y, dt, level, noise, float(contrast), profile, frozen)
    spacing = (make.spacing[0] * make.spacing[1]) ** 0.5
    limits = _limits(y, z)

    best = None
    level_images = make(*_LEVELS[0])
    for start in starting_points(_differences(level_images), _STARTS, profile):
        parameters = torch.cat([start, start.new_tensor([1.0, 0.0])])
        found = fit(level_images, parameters, limits, spacing**2, 12, _TOLERANCE)
        if best is None or found.cost < best.cost:
            best = found
    if best is None:
        return _no_fit(profile, "nothing turns")
    variance = (_FIRST_FLOW_ERROR * spacing) ** 2
    for blur, step in _LEVELS[1:]:
        level_images = make(blur, step)
        best = fit(level_images, best.parameters, limits, variance, 12, _TOLERANCE)
    for _ in range(2):
        error = _flow_error(best, _NOISE_LAGS)
        best = fit(level_images, best.parameters, limits, error.variance, 10, _TOLERANCE)
    error = _flow_error(best, _NOISE_LAGS)
    covariance = _covariance(best, error, level_images.spline.excess)
    misfit, seen = best.misfit, best.misfit.seen
    # image 1 at its places, and image 2 at its own: the residual with image 1 put back
    first = -misfit.jacobian[10]
    second = misfit.residual + best.parameters[10] * first
    match = float(torch.corrcoef(torch.stack([first[seen], second[seen]]))[0, 1])
    known = make.noise > 0
    chi2 = float((misfit.residual.square() / misfit.scatter)[seen].mean()) if known else np.nan
    return _checked_fit(
        best,
        covariance,
        profile,
        chi2,
        match,
        error.variance**0.5 / dt,
        mean_length(error) * spacing,
        z,
        y,
    )


def _understated(noise: torch.Tensor, pair: torch.Tensor) -> float:
    """By how much more than a map says the pictures vary from pixel to pixel, at least 1.

    Errors estimated from a few photons know nothing of the rare ones that none of them was. With too
    low a noise the filter takes what is left of it for texture and passes all of it. Texture down to
    single pixels counts as noise here, which costs little: in pictures 150 m ahead noise comes out half
    as large again, and chi2 at 0.4, with the errors of the parameters as they were.
    """
    said = float(noise[torch.isfinite(noise)].double().square().mean().sqrt())
    _, seen = band_limited(pair)
    return max(1.0, seen / said) if said > 0 else 1.0


def _typical(noise: float | torch.Tensor | None, contrast: torch.Tensor) -> float | None:
    """One standard deviation for the filter: where pixels differ, the rms where the structure is.

    That of most pixels will not do: where bright air is the noisiest the filter would stop too
    little of it, and circulations come out up to a tenth too large.
    """
    if not isinstance(noise, torch.Tensor):
        return noise
    known = torch.isfinite(noise)
    variance = noise[known].double().square()
    return float(((variance * contrast[known]).sum() / contrast[known].sum()).sqrt())


def vortex_windows(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    axes: tuple[np.ndarray, np.ndarray],
    dt: float,
    noise: float | torch.Tensor | None = None,
) -> Displacement:
    """The wind of a fitted pair at the windows' centres, as displacement in dt.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
    template, search, stride : int
        Pixels; they say where vectors are wanted and nothing else.
    axes : (array, array)
        z and y of the pixels, m.
    dt : float
        s.
    noise : float or torch.Tensor, optional
        As `fit_vortices`.

    Returns
    -------
    Displacement
        With the pair's `quantities`. Without a fit that can be believed every vector has the flag
        NO_MATCH, and no number where there is none.
    """
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    found = fit_pixels(image1, image2, *axes, dt, noise, "lamb_oseen")
    centres = [
        (axis[start := np.asarray(windows.starts(k))] + axis[start + template - 1]) / 2
        for k, axis in enumerate(axes)
    ]
    values, covariance = found.wind_and_covariance(centres[1][None, :], centres[0][:, None])
    pixel_z, pixel_y = (float(a[-1] - a[0]) / (len(a) - 1) / dt for a in axes)

    def tensor(array):
        return torch.as_tensor(np.ascontiguousarray(array), device=image1.device)

    v, w = tensor(values)
    variances = tensor(covariance)
    flag = torch.zeros(windows.count, dtype=torch.uint8, device=image1.device)
    flag[non_finite(image1, image2, windows)] |= Flag.NON_FINITE_INPUT.value
    if not found.success:
        flag |= Flag.NO_MATCH.value
    if "an image is constant" in found.reasons:
        flag |= Flag.LOW_TEXTURE.value
    return Displacement(
        w / pixel_z,
        v / pixel_y,
        torch.full_like(v, found.correlation),
        flag,
        torch.stack(
            [
                variances[1] / pixel_z**2,
                variances[0] / pixel_y**2,
                variances[2] / (pixel_y * pixel_z),
            ]
        ),
        found.quantities,
        {
            "profile": found.profile,
            "fit": "; ".join(found.reasons) or "good",
            "chi2": found.chi2,
            "flow_error": found.flow_error,
            "flow_error_length": found.flow_error_length,
        },
    )


@dataclass(frozen=True)
class _Builder:
    """Images of the levels, from coarse to fine."""

    pair: torch.Tensor
    bad: torch.Tensor
    z: np.ndarray
    y: np.ndarray
    dt: float
    level: float | None
    map: float | torch.Tensor | None
    contrast: float
    profile: Profile
    frozen: bool

    @property
    def spacing(self) -> tuple[float, float]:
        return tuple(float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (self.y, self.z))

    @cached_property
    def sharp(self) -> tuple[Spline, float]:
        return band_limited(self.pair, self.level)

    @cached_property
    def unfiltered(self) -> Spline:
        return band_limited(self.pair, 0.0)[0]

    @property
    def noise(self) -> float:
        return self.sharp[1]

    def __call__(self, blur: float, step: int) -> _Images:
        spline, noise = self.sharp
        passed = spline.passed
        if blur:
            size = 2 * int(np.ceil(4 * blur)) + 1
            size = tuple(min(size, 2 * n - 1) for n in self.pair.shape[1:])
            soft = gaussian_blur2d(self.pair[None], size, (blur, blur), "replicate")[0]
            spline, _ = band_limited(soft, 0.0)
            passed = 1 / (4 * np.pi * blur**2)
        places = [
            torch.as_tensor(axis[step // 2 :: step], device=self.pair.device)
            for axis in (self.z, self.y)
        ]
        vertical, lateral = torch.meshgrid(*places, indexing="ij")
        variance = torch.full_like(lateral, 2 * noise**2)
        if isinstance(self.map, torch.Tensor):
            # the filter carries noise a few pixels on, and of few photons no pixel knows its own
            known = torch.nn.functional.avg_pool2d(
                filled(self.map.double())[None].square(), 9, 1, 4, count_include_pad=False
            )[0]
            variance = 2 * known[step // 2 :: step, step // 2 :: step] / self.contrast**2
        floor = 2 * _INTERPOLATION**2
        whole = spline if blur or noise == 0 else self.unfiltered
        return _Images(
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
        )


def _differences(images: _Images) -> Observations:
    """What blurred images say of the wind where they stand: I2 - I1 = -dt u . slope."""
    rows = (images.z - images.first[1]) / images.spacing[1]
    columns = (images.y - images.first[0]) / images.spacing[0]
    value, slope_z, slope_y = images.spline.sample(*(torch.stack([p, p]) for p in (rows, columns)))
    slope = torch.stack([slope_y.mean(0) / images.spacing[0], slope_z.mean(0) / images.spacing[1]])
    clean = ~images.bad[rows.round().long(), columns.round().long()]
    strength = slope.square().sum(0)
    # all pixels may be off by a pixel's displacement
    weight = 1 / (images.scatter + strength * images.spacing[0] * images.spacing[1])
    parts = (images.y, images.z, *slope, value[1] - value[0], weight)
    y, z, slope_y, slope_z, change, weight = (part[clean] for part in parts)
    return Observations(y, z, -images.dt * torch.stack([slope_y, slope_z]), change, weight)


def _limits(y: np.ndarray, z: np.ndarray) -> Callable[[torch.Tensor, torch.Tensor], bool]:
    """Steps that stay near and keep core radii between a cell and the region."""
    sides = float(y[-1] - y[0]), float(z[-1] - z[0])
    cell = max(sides[0] / (len(y) - 1), sides[1] / (len(z) - 1))
    smallest, largest = np.log(cell / 2), np.log(min(sides) / 2)

    def allowed(parameters: torch.Tensor, step: torch.Tensor) -> bool:
        radii = (parameters + step)[[1, 5]]
        near = step[[2, 3, 6, 7]].abs().max() <= 0.15 * min(sides)
        return bool(
            near
            and step[[1, 5]].abs().max() <= 1
            and radii.min() >= smallest
            and radii.max() <= largest
        )

    return allowed


# --- from vectors


@dataclass(frozen=True)
class _Vectors:
    """Wind vectors on a grid, whitened by their covariance; call with parameters for the misfit."""

    y: torch.Tensor
    z: torch.Tensor
    root: torch.Tensor
    """Inverse of the covariance's Cholesky factor, (2, 2, z, y)."""
    value: torch.Tensor
    seen: torch.Tensor
    profile: Profile

    def __call__(self, parameters: torch.Tensor) -> Misfit:
        off = self.value - wind(parameters, self.y, self.z, self.profile)
        residual = (self.root * off).sum(1)
        jacobian = torch.stack(
            [-sensitivity(parameters, self.y, self.z, along, self.profile) for along in self.root],
            1,
        )
        one = torch.ones_like(residual)
        seen = self.seen.expand_as(residual)
        return Misfit(residual, jacobian, -self.root.transpose(0, 1), seen, one, one)


def fit_vortices_to_wind(vectors: xr.Dataset, profile: Profile = "lamb_oseen") -> VortexPairFit:
    """Two vortices and a mean wind that explain retrieved vectors.

    Parameters
    ----------
    vectors : Dataset, dims (z, y)
        As `lidar_mi.retrieval.velocimetry.wind.retrieve_wind` gives it: v, w, and where there are any
        v_stderr, w_stderr, vw_correlation, flag, y_vector, z_vector. Vectors with a flag or without
        a number are left out. Without standard errors all count alike, with the error that
        their residuals show.
    profile : {"lamb_oseen", "burnham_hallock"}

    Returns
    -------
    VortexPairFit
        Errors that neighbouring vectors share are seen in their residuals and count as the flow's.

    Raises
    ------
    InputError
        Variables missing, or fewer than 20 vectors.
    """
    _check_profile(profile)
    for name in ("v", "w"):
        if name not in vectors:
            raise InputError(f"vectors.{name}: missing; expected v and w on (z, y)")
    vectors = vectors.transpose("z", "y")

    def field(name, default=None):
        if name not in vectors and name not in vectors.coords:
            return default
        return np.broadcast_to(vectors[name].values.astype(float), vectors["v"].shape)

    z, y = (vectors[name].values.astype(float) for name in ("z", "y"))
    vertical, lateral = np.meshgrid(z, y, indexing="ij")
    value = np.stack([field("v"), field("w")])
    place = np.stack([field("y_vector", lateral), field("z_vector", vertical)])
    good = np.isfinite(value).all(0) & np.isfinite(place).all(0)
    good &= field("flag", np.zeros(good.shape)) == 0
    stderr = [field(name, np.full(good.shape, np.nan)) for name in ("v_stderr", "w_stderr")]
    stderr = np.stack(stderr)
    known = bool(np.isfinite(stderr[:, good]).any())
    if known:
        good &= (np.isfinite(stderr) & (stderr > 0)).all(0)
    if int(good.sum()) < 20:
        raise InputError(f"vectors: {int(good.sum())} are good; expected at least 20")
    stderr = np.where(good, stderr if known else 1.0, 1.0)
    shared = np.nan_to_num(field("vw_correlation", np.zeros(good.shape))) * good
    shared = shared.clip(-0.999, 0.999) if known else 0 * shared
    root = np.zeros((2, 2, *good.shape))
    root[0, 0] = 1 / stderr[0]
    root[1, 0] = -shared / np.sqrt(1 - shared**2) / stderr[0]
    root[1, 1] = 1 / np.sqrt(1 - shared**2) / stderr[1]

    tensors = [torch.as_tensor(np.where(good, a, 0.0)) for a in (*place, value)]
    seen = torch.as_tensor(good)
    model = _Vectors(*tensors[:2], torch.as_tensor(root), tensors[2], seen, profile)
    limits = _limits(y, z)
    flow_variance = float(np.square(value[:, good]).mean()) / 4
    best = None
    for start in starting_points(_components(model, flow_variance), _STARTS, profile):
        found = fit(model, start, limits, flow_variance, 30, _TOLERANCE)
        if best is None or found.cost < best.cost:
            best = found
    if best is None:
        return _no_fit(profile, "nothing turns")
    if not known:
        off = best.misfit.residual[:, seen]
        spread = float(1.4826 * (off - off.median()).abs().median())
        if spread > 0:
            model = _Vectors(
                *tensors[:2], torch.as_tensor(root) / spread, tensors[2], seen, profile
            )
    for _ in range(3):
        error = _flow_error(best, 1.0)
        best = fit(model, best.parameters, limits, error.variance, 12, _TOLERANCE)
    error = _flow_error(best, 1.0)
    covariance = _covariance(best, error, 1.0)
    chi2 = float(best.misfit.residual[:, seen].square().mean()) if known else np.nan
    left = (tensors[2] - wind(best.parameters, *tensors[:2], profile))[:, seen]
    varied = tensors[2][:, seen] - tensors[2][:, seen].mean(1, keepdim=True)
    explained = 1 - float(left.square().sum() / varied.square().sum())
    spacing = (float(np.diff(y).mean()) * float(np.diff(z).mean())) ** 0.5
    return _checked_fit(
        best,
        covariance,
        profile,
        chi2,
        explained,
        error.variance**0.5,
        mean_length(error) * spacing,
        z,
        y,
    )


def _components(vectors: _Vectors, flow_variance: float) -> Observations:
    """Vectors as single components, thinned to a few hundred places."""
    step = max(1, round((float(vectors.seen.sum()) / 1000) ** 0.5))
    part = (Ellipsis, slice(step // 2, None, step), slice(step // 2, None, step))
    seen = vectors.seen[part]
    root, value = vectors.root[part][..., seen], vectors.value[part][..., seen]
    along = root.transpose(0, 1)
    weight = 1 / (1 + flow_variance * along.square().sum(0))
    y, z = (axis[part][seen] for axis in (vectors.y, vectors.z))
    return Observations(
        y.repeat(2),
        z.repeat(2),
        along.flatten(1),
        (root * value).sum(1).flatten(),
        weight.flatten(),
    )


# --- what both share


def _flow_error(found: Solution, shortest: float) -> FlowError:
    misfit = found.misfit
    residual, slope, weight = misfit.residual, misfit.slope, found.weight
    if residual.ndim == 2:
        residual, slope, weight = residual[None], slope[:, None], weight[None]
    pushed = (slope * weight * residual).sum(1)
    stiffness = torch.stack(
        [(weight * slope[a] * slope[b]).sum(0) for a, b in ((0, 0), (0, 1), (1, 1))]
    )
    return flow_error(pushed, stiffness, shortest)


def _covariance(found: Solution, error: FlowError, excess: float) -> np.ndarray:
    """Covariance (10, 10): H^-1 M H^-1 with the noise's and the flow error's spread M of the force."""
    misfit, weight = found.misfit, found.weight
    spread = _noise_spread(found, error) * excess
    jacobian, slope = misfit.jacobian, misfit.slope
    if weight.ndim == 2:
        weight, jacobian, slope = weight[None], jacobian[:, None], slope[:, None]
    pulls = torch.einsum("ozy,pozy,aozy->pazy", weight, jacobian, slope)
    spread = spread + spread_of(pulls, error)
    scale = found.normal.diagonal().sqrt()
    inverse = torch.linalg.pinv(found.normal / scale / scale[:, None], hermitian=True)
    inverse = inverse / scale / scale[:, None]
    covariance = (inverse @ spread @ inverse)[:10, :10]
    drawn = _drawn_to_rest(found)
    covariance = covariance + torch.outer(drawn, drawn)
    if not found.converged:
        left = _step_left(found)
        covariance = covariance + torch.outer(left, left)
    return covariance.cpu().numpy()


def _noise_spread(found: Solution, error: FlowError) -> torch.Tensor:
    """Covariance of the force that noise makes: as the noise is said to be, or larger as it is seen.

    Seen, each residual stands for its own variance (White 1980, Econometrica 48, 817), whatever
    pixels are noisier than they are said to be.
    """
    misfit, weight = found.misfit, found.weight
    columns = misfit.jacobian.flatten(1)
    moved = error.variance * misfit.slope.square().sum(0)
    share = (misfit.residual.square() / (misfit.scatter + moved)).where(misfit.seen, 0.0)
    said, seen = (
        (columns * (weight**2 * part).flatten()) @ columns.T
        for part in (misfit.variance, misfit.variance * share)
    )
    scale = found.normal.diagonal()
    more = float((seen.diagonal() / scale).sum() / (said.diagonal() / scale).sum())
    return seen if more > 1 else said


def _step_left(found: Solution) -> torch.Tensor:
    """The step (10,) that a fit would still take, where noise in the interpolation stopped it."""
    misfit, weight = found.misfit, found.weight
    force = -misfit.jacobian.flatten(1) @ (weight * misfit.residual).flatten()
    scale = found.normal.diagonal().sqrt()
    scaled = torch.linalg.pinv(found.normal / scale / scale[:, None], hermitian=True)
    return (scaled @ (force / scale) / scale)[:10]


def _far_from_rest(found: Solution, covariance: np.ndarray) -> bool:
    """Whether the step left is more than a standard error of any parameter, itself apart."""
    left = _step_left(found).cpu().numpy() ** 2
    return not (left < np.diagonal(covariance) - left).all()


def _drawn_to_rest(found: Solution) -> torch.Tensor:
    """How far the circulations may be drawn toward zero, as an error of all parameters (10,).

    Structure that has been wound up for long lies along the flow: little changes, and what
    remains unexplained may as well be the model's error, seen where the true flow shows nothing.
    Regressing the other way round (errors in the model, not in the change) would make both
    circulations larger by the unexplained share of the change: that much is admitted.
    """
    misfit, theta = found.misfit, found.parameters
    explained = theta[0] * misfit.jacobian[0] + theta[4] * misfit.jacobian[4]
    left = float((found.weight * (misfit.residual.square() - misfit.scatter))[misfit.seen].sum())
    power = float((found.weight * explained.square())[misfit.seen].sum())
    share = max(0.0, left / power) if power > 0 else 0.0
    drawn = torch.zeros_like(theta[:10])
    drawn[0], drawn[4] = share * theta[0], share * theta[4]
    return drawn


def _no_fit(profile: Profile, reason: str) -> VortexPairFit:
    nothing = np.full(10, np.nan)
    return VortexPairFit(
        nothing, np.full((10, 10), np.nan), profile, np.nan, np.nan, np.nan, np.nan, (reason,)
    )


def _checked_fit(
    found: Solution, covariance, profile, chi2, match, error, length, z, y
) -> VortexPairFit:
    theta = found.parameters[:10].cpu().numpy()
    reasons = []
    if not found.converged and _far_from_rest(found, covariance):
        reasons.append("did not converge")
    if not match >= _MATCH:
        reasons.append(f"what the fit carries together correlates by {match:.2f} only")
    if not (np.isfinite(covariance).all() and (np.diagonal(covariance) > 0).all()):
        reasons.append("some parameters are not determined at all")
    spread = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    for side, first in (("port", 0), ("starboard", 4)):
        circulation, _, at_y, at_z = theta[first : first + 4]
        sign = 1 if side == "port" else -1
        if not sign * circulation > _SIGNIFICANCE * spread[first]:
            reasons.append(
                f"{side} circulation {circulation:.0f} +- {spread[first]:.0f} m2/s tells no vortex"
            )
        if not (y[0] <= at_y <= y[-1] and z[0] <= at_z <= z[-1]):
            reasons.append(f"{side} vortex at ({at_y:.1f}, {at_z:.1f}) m is outside")
    return VortexPairFit(theta, covariance, profile, chi2, match, error, length, tuple(reasons))


def _check_profile(profile) -> None:
    if profile not in PROFILES:
        raise InputError(f"profile: {profile!r} is not one of {', '.join(PROFILES)}")
