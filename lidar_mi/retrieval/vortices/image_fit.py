"""A pair of wake vortices from two images: the model that fits both images best.

No wind vectors are needed in between: the whole image informs the ten parameters at once. So this
works where the texture is too weak for any local method, and elsewhere as well as the noise allows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_stack, on_device, positive
from lidar_mi.retrieval.defects.rest import all_at_rest
from lidar_mi.retrieval.device import within_memory
from lidar_mi.retrieval.images.beam_times import checked_times
from lidar_mi.retrieval.images.inpainting import filled_in
from lidar_mi.retrieval.images.intensity import normalised
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.retrieval.vortices.acceptance import (
    NOT_TOLD,
    STARTS,
    TOLERANCE,
    Limits,
    check_profile,
    no_fit,
    step_limits,
    with_reasons,
    within,
)
from lidar_mi.retrieval.vortices.ambient import Ambient, ambient_errors, in_ambient_wind
from lidar_mi.retrieval.vortices.covariance import (
    change_by_flow,
    curvature,
    model_error_of,
    parameter_covariance,
    shared_error,
)
from lidar_mi.retrieval.vortices.detection import detect
from lidar_mi.retrieval.vortices.from_start import StartedFit, agrees, fit_from, fit_near, start_fit
from lidar_mi.retrieval.vortices.image_builder import Acquisition, builder_of, near_to
from lidar_mi.retrieval.vortices.images import SAME_BRIGHTNESS, Builder, Images
from lidar_mi.retrieval.vortices.model import Profile, wind
from lidar_mi.retrieval.vortices.model_error import ModelError, mean_length
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.robust_fit import Misfit, Solution, fit, without_step
from lidar_mi.retrieval.vortices.search import condensed, starting_points

# Coarse to fine: standard deviation of the blur and step between the pixels used, px.
_LEVELS = ((3.0, 4), (1.5, 2), (0.0, 1))
# Model error assumed at first (px); later it is estimated.
_FIRST_MODEL_ERROR = 0.1
# Fraction of the images' difference that may be change, for the search.
_CHANGE = 0.25
# Fraction of the images' variance that is other air from which finer images are searched, too.
_REPLACED = 0.1
# Lags (px) over which the noise of band-limited images correlates.
_NOISE_LAGS = 4.0
# Least probability of a vortex with which a detected pair is fitted: below it are 0.3 % of the
# wakes that the probability is calibrated on, and 43 % of the air without one.
_LEAST_PROBABILITY = 0.05
# Core radii of the starts over that of the filters: a fit of wider cores converges farther off.
_CORES = (1.0, 2.0)
# Expected error of the displacements of a detected pair, px: of its places on a raster.
_DETECTED = 1.0


@checked_arguments
def fit_vortices(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray | None = None,
    profile: Profile = "lamb_oseen",
    *,
    frozen: bool = False,
    times: Sequence[xr.DataArray] | None = None,
    start: VortexPairFit | None = None,
    telescope: tuple[float, float, float] | None = None,
    device: str | torch.device = "cpu",
) -> VortexPairFit:
    """Two vortices and a mean wind that advect image 1 into image 2.

    Every pixel is followed along its curved path to half a dt before and after mid-time; there the
    images must agree, except for a gain and an offset. The squares of their difference are
    minimised. Their weights are the inverse of the variance of the noise plus that of the model
    error times the gradient of the image; the model error is estimated from the residuals of the
    same fit. The start is the best of all pairs of positions (see
    `lidar_mi.retrieval.vortices.search`); no guess is needed. Where a pair is expected, as in the
    next of many slabs of air, the fit starts there in a fraction of the time.

    Parameters
    ----------
    image1, image2 : DataArray, dims (z, y)
        On one grid, as `lidar_mi.retrieval.wind.pair.retrieve_wind` takes them. NaN pixels
        are masked, and so are those of non-advected structure (`rest.all_at_rest`).
    dt : float
        s.
    noise : float or DataArray, optional
        Standard deviation of each image's white noise, in image 1's unit, of all pixels or of
        each. Without it, or 0 in each: from the images' spectra.
    profile : {"lamb_oseen", "burnham_hallock"}
    frozen : bool
        The vortices do not move during dt. Default: they drift with the mean wind and their mutual
        induction.
    times : sequence of two DataArray, optional
        Times of the pixels, s from the reference time of their image, as `retrieve_wind` takes
        them. Air is followed to the time of the pixel that shows it; the pair is that at dt / 2
        after image 1's reference time.
    start : VortexPairFit, optional
        The pair expected at mid-time, with its covariance. It is where the fit starts, and is not
        weighted in. A fit that is not accepted, or further from it than both errors allow, is
        replaced by that of a search; see `from_start`.
    telescope : (float, float, float), optional
        x, y and z from the images' plane, m, of the telescope whose beams reach its pixels
        obliquely, x < 0. The fit is that of a pair along x; with a telescope its
        `VortexPairFit.with_slopes` corrects it for a pair that is inclined.
    device : str or torch.device

    Returns
    -------
    VortexPairFit
        Look at `success` and `reasons` first.

    Raises
    ------
    InputError
        Images on different or unsuitable grids, a parameter out of its range.

    Examples
    --------
    Textured air in the wind of a pair, 0.05 s before and after mid-time:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.ndimage import gaussian_filter, map_coordinates
    >>> from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
    >>> y, z = np.arange(-40.0, 41.0), np.arange(-25.0, 26.0)
    >>> v, w = velocity(vortex_pair(300.0, separation=30.0, core_radius=3.0), y, z[:, None])
    >>> air = 1 + gaussian_filter(np.random.default_rng(1).normal(size=(z.size, y.size)), 1.5)
    >>> row, column = np.mgrid[: z.size, : y.size]
    >>> axes = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    >>> moved = [
    ...     map_coordinates(air, [row - t * w, column - t * v], mode="nearest")
    ...     for t in (-0.05, 0.05)
    ... ]
    >>> image1, image2 = (xr.DataArray(image, axes, ("z", "y")) for image in moved)
    >>> pair = lm.fit_vortices(image1, image2, dt=0.1)
    >>> pair.success, abs(pair.port.circulation - 300) < 10
    (True, True)
    """
    stack, noise = checked_stack([image1, image2], noise)
    taken = _checked_acquisition(stack, dt, noise, profile, frozen, times, telescope, device)
    _check_start(start, profile)
    pixels = [on_device(image, device) for image in stack]

    def fitted() -> VortexPairFit:
        first, second = pixels
        # smaller images hold no search region, in which motion around structure is found
        if min(image1.shape) >= Windows.search:
            first, second = all_at_rest(pixels, Windows(tuple(image1.shape))).masked(pixels)
        return fit_pixels(first, second, taken, start)

    with threads_for(image1.size):
        return within_memory(fitted)


def detected_fit(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray | None = None,
    profile: Profile = "lamb_oseen",
    *,
    frozen: bool = False,
    times: Sequence[xr.DataArray] | None = None,
    telescope: tuple[float, float, float] | None = None,
    device: str | torch.device = "cpu",
) -> VortexPairFit:
    """`fit_vortices` in a short time whatever the images show: for slabs without an expected pair.

    Matched filters (`lidar_mi.retrieval.vortices.detection`) give the likeliest pair and the
    probability of a vortex, and the fit starts there, as from an expected pair. There is no search
    and, as in `started_fit`, no mask of non-advected structure.

    image1, image2, dt, noise, profile, frozen, times, telescope, device: as `fit_vortices` takes
        them.

    Raises InputError: as `fit_vortices`.

    Returns
    -------
    VortexPairFit
        With its `probability`. Not a success where that is below 0.05, or where the fit is not
        accepted; of no fit at all the parameters are those of the likeliest pair.
    """
    stack, noise = checked_stack([image1, image2], noise)
    taken = _checked_acquisition(stack, dt, noise, profile, frozen, times, telescope, device)
    first, second = (on_device(image, device) for image in stack)
    with threads_for(image1.size):
        return within_memory(lambda: _detected(first, second, taken))


def _detected(first: torch.Tensor, second: torch.Tensor, taken: Acquisition) -> VortexPairFit:
    make = builder_of([first, second], taken)
    if isinstance(make, str):
        return no_fit(taken.profile, make)
    make = make.single()
    probability, likeliest = detect(make)
    if likeliest is None or probability < _LEAST_PROBABILITY:
        refused = no_fit(taken.profile, f"probability of a vortex {probability:.1%}")
        return replace(refused, probability=probability)
    theta = torch.cat([likeliest, likeliest.new_tensor(SAME_BRIGHTNESS)])
    limits = step_limits(make.y, make.z, make.profile, make.dt)
    for wider in _CORES:
        start = theta.clone()
        start[[1, 5]] += math.log(wider)
        near = fit_near(start, make, limits, _NOISE_LAGS, _DETECTED, estimates=2)
        if near:
            return replace(_checked(make, *near), probability=probability)
    refused = no_fit(taken.profile, "no fit near the likeliest pair")
    return replace(refused, parameters=likeliest.cpu().numpy(), probability=probability)


def started_fit(
    image1: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray | None = None,
    profile: Profile = "lamb_oseen",
    *,
    start: VortexPairFit,
    frozen: bool = False,
    times: Sequence[xr.DataArray] | None = None,
    telescope: tuple[float, float, float] | None = None,
    device: str | torch.device = "cpu",
) -> Callable[[xr.DataArray], VortexPairFit]:
    """`fit_vortices` near an expected pair, started before the second image is known.

    The first image's filter, its splines, and the paths of the air are computed at once: a quarter
    of the work. The filter of both images is that of the first one's spectrum. A fit that is not
    accepted, or further from the start than both errors allow, is replaced by `detected_fit`.

    Returns
    -------
    callable
        Takes image 2, on the grid of image 1, and gives the fit.
    """
    (image1,), noise = checked_stack([image1], noise)
    taken = _checked_acquisition(
        [image1, image1], dt, noise, profile, frozen, times, telescope, device
    )
    _check_start(start, profile)
    with threads_for(image1.size):
        started = _started(builder_of([on_device(image1, device)], taken), start)
    return partial(_with_second, image1, started, taken, device)


def _with_second(
    image1: xr.DataArray,
    started: StartedFit | None,
    taken: Acquisition,
    device: str | torch.device,
    image2: xr.DataArray,
) -> VortexPairFit:
    pair, _ = checked_stack([image1, image2])
    first, second = (on_device(image, device) for image in pair)
    with threads_for(image1.size):
        near = started and _completed(started, first, second)
        return near or _detected(first, second, taken)


def _check_start(start: VortexPairFit | None, profile: Profile) -> None:
    if start is not None and start.profile != profile:
        raise InputError(f"start.profile: {start.profile!r} is not {profile!r}, that of the fit")


def _checked_acquisition(
    stack: Sequence[xr.DataArray],
    dt: float,
    noise: float | xr.DataArray | None,
    profile: Profile,
    frozen: bool,
    times: Sequence[xr.DataArray] | None,
    telescope: tuple[float, float, float] | None,
    device: str | torch.device,
) -> Acquisition:
    dt = positive("dt", dt)
    check_profile(profile)
    if telescope is not None and not (np.isfinite(telescope).all() and telescope[0] < 0):
        raise InputError(
            f"telescope: {telescope} m is not allowed; expected finite x, y and z with x < 0"
        )
    tau = checked_times(times, stack, dt)
    z, y = (stack[0].coords.variables[name].values.astype(float) for name in ("z", "y"))
    level = on_device(noise, device) if isinstance(noise, xr.DataArray) else noise
    return Acquisition(z, y, dt, level, profile, frozen, tau, telescope)


def fit_pixels(
    image1: torch.Tensor,
    image2: torch.Tensor,
    taken: Acquisition,
    start: VortexPairFit | None = None,
) -> VortexPairFit:
    """`fit_vortices` on tensors (z, y)."""
    if start is not None:
        started = _started(builder_of([image1], taken), start)
        pair = started and _completed(started, image1, image2)
        if pair:
            return pair
    # a search in double precision: rounding would decide between solutions of equal cost
    make = builder_of([image1, image2], taken)
    if isinstance(make, str):
        return no_fit(taken.profile, make)
    limits = step_limits(taken.y, taken.z, taken.profile, taken.dt)
    fit, replaced = _searched(make, limits)
    if fit is None:
        return no_fit(taken.profile, "no vortex signature")
    # in air that is replaced there are many minima: a few steps may end in another one
    if not replaced:
        near = fit_near(fit.parameters, make, limits, _NOISE_LAGS, estimates=2)
        pair = near and _checked(make, *near)
        if pair and pair.success:
            return pair
    return _iterated(fit, make, limits)


def _started(make: Builder | str, start: VortexPairFit) -> StartedFit | None:
    """The fit near an expected pair without image 2; None if there is none.

    `make` is that of image 1, or the reason for which there is none.
    """
    if isinstance(make, str):
        return None
    limits = step_limits(make.y, make.z, make.profile, make.dt)
    # steps need no more: places to 1e-5 m
    return start_fit(start, make.single(), limits)


def _completed(
    started: StartedFit, image1: torch.Tensor, image2: torch.Tensor
) -> VortexPairFit | None:
    """The fit near the expected pair; None if it is not accepted or does not agree with it."""
    finite, make = torch.isfinite(image2), started.make
    second = filled_in(normalised([image1, image2])[1]) / make.contrast
    if float((finite & ~make.bad).double().mean()) < 0.5 or not bool(second.std() > 0):
        return None
    both = torch.cat([make.pair, second[None].to(make.pair)])
    make = replace(make, pair=both, bad=make.bad | near_to(~finite))
    limits = step_limits(make.y, make.z, make.profile, make.dt)
    near = fit_from(started, make, limits, _NOISE_LAGS)
    pair = near and replace(_checked(make, *near), from_start=True)
    return pair if pair and pair.success and agrees(started.start, pair) else None


def _searched(make: Builder, limits: Limits) -> tuple[Solution | None, bool]:
    """The fit to blurred images from the best of all pairs of places, None if there is none.

    And whether part of the air is replaced.

    Blurred differences of images are linear in displacements of several pixels. Where air changes
    they are mostly change, and the pair is in the finer ones, of which there are more.
    """
    spacing = (make.spacing[0] * make.spacing[1]) ** 0.5
    images = make(*_LEVELS[0])
    images = images.at_least(_CHANGE * float(images.differences().value.var()))
    starts = starting_points(images.differences(), STARTS, make.profile)
    best = _best(images, starts, limits, spacing**2)
    if best is None:
        return None, False
    variance = (_FIRST_MODEL_ERROR * spacing) ** 2
    white = make(*_LEVELS[1])
    solution, images = _refitted(white, best.parameters, variance, limits)
    if _replaced(white.weighted(solution.misfit)) < _REPLACED:
        return solution, False
    observed = condensed(white.at_least(float(images.scatter.mean())).differences())
    starts = starting_points(observed, STARTS, make.profile)
    others = _best(images, starts, limits, variance)
    # both are fits to the same images, so that costs compare
    return (others if others and others.cost < solution.cost else solution), True


def _best(images: Images, starts: torch.Tensor, limits: Limits, variance: float) -> Solution | None:
    """The fit of the least cost from starting points (n, 10), None if there are none."""
    solutions = [
        fit(
            images,
            torch.cat([start, start.new_tensor(SAME_BRIGHTNESS)]).double(),
            limits,
            variance,
            12,
            TOLERANCE,
        )
        for start in starts
    ]
    return min(solutions, key=lambda solution: solution.cost, default=None)


def _replaced(misfit: Misfit) -> float:
    """Fraction of the variance of the images that is not the same air, beyond noise."""
    valid = misfit.valid
    excess = (misfit.residual.square() - misfit.scatter)[valid].mean()
    # the derivative by the gain is image 1
    return float(excess / misfit.jacobian[10][valid].var())


def _refitted(
    white: Images, parameters: torch.Tensor, variance: float, limits: Limits
) -> tuple[Solution, Images]:
    """The fit to images, and these with noise as large as the residuals of the parameters so far.

    With weights of the noise alone, air that changes gives a sum of squares with many minima.
    """
    misfit = white(parameters)
    power = without_step(misfit, variance)[misfit.valid].square().mean()
    images = white.at_least(float(power))
    return fit(images, parameters, limits, variance, 12, TOLERANCE), images


def _iterated(solution: Solution, make: Builder, limits: Limits) -> VortexPairFit:
    """The fit from that to blurred images, by steps until it converges: far starts, no noise."""
    white = make(*_LEVELS[2])
    best, images = _refitted(white, solution.parameters, 0.0, limits)
    # twice, as the filter follows from the residuals and the residuals from the filter
    for _ in range(2):
        error = model_error_of(best, _NOISE_LAGS, changes=True)
        images = make.with_change(white, images, best.misfit, error.variance)
        if not images.passed > 0:
            return no_fit(make.profile, "the images have no structure in common")
        best = fit(images, best.parameters, limits, error.variance, 10, TOLERANCE)
    ambient = in_ambient_wind(best, white.y, white.z, make.dt)
    if within(limits, best.parameters, ambient.solution) is None:
        return no_fit(make.profile, NOT_TOLD)
    error = model_error_of(ambient.solution, _NOISE_LAGS, changes=True)
    return _checked(make, ambient, images, white(best.parameters), error)


def _checked(
    make: Builder, ambient: Ambient, images: Images, misfit: Misfit, error: ModelError
) -> VortexPairFit:
    """The pair of a solution in images, with its errors; `misfit` is that without whitening."""
    best = ambient.solution
    # half of the slopes of noise and change are in those of the mean: the misfit curves less
    q = curvature(best, make.spacing)
    # parameters follow a departure: they err by all of it, not by what they have left
    departure = model_error_of(best, _NOISE_LAGS, changes=True, before=error)
    by_air = ambient_errors(ambient)
    covariance = parameter_covariance(best, error, departure, 1 / q**2, by_air.covariance)
    valid = misfit.valid
    # image 1 at its places, and image 2 at its own: the residual with image 1 times its gain
    first = -misfit.jacobian[10]
    gain = best.parameters[10:13].to(first)
    second = misfit.residual - torch.tensordot(gain, misfit.jacobian[10:13], 1)
    match = float(torch.corrcoef(torch.stack([first[valid], second[valid]]))[0, 1])
    known = make.noise > 0
    chi2 = float((misfit.residual.square() / misfit.scatter)[valid].mean()) if known else np.nan
    scope = make.telescope
    shared, length = shared_error(by_air)
    pair = VortexPairFit(
        best.parameters[:10].cpu().numpy(),
        covariance,
        make.profile,
        chi2,
        match,
        error.variance**0.5 / make.dt,
        mean_length(error) * (make.spacing[0] * make.spacing[1]) ** 0.5,
        # a roll rate of 1 rad/s that is not known moves the images by this
        turned=change_by_flow(best, make.dt * torch.stack([-images.z, images.y])),
        inclined=None if scope is None else _change_by_slopes(make, scope, best, images),
        ambient=ambient.wind,
        shared=shared,
        shared_length=length,
    )
    return with_reasons(pair, best, make.y, make.z, by_air.further)


def _change_by_slopes(
    make: Builder, telescope: tuple[float, float, float], best: Solution, images: Images
) -> np.ndarray:
    """Change (10, 2) of the parameters per slope dy/dx and dz/dx of the pair's axis.

    The swirl (u, v, w) is across the axis, so that u is minus the slopes times (v, w). Air that
    moves along x in oblique beams moves by -(y, z) u / distance in the images.
    """
    x, y, z = telescope
    swirl = wind(best.parameters[:10].to(images.y), images.y, images.z, make.profile)
    swirl = swirl - best.parameters[8:10, None, None].to(swirl)
    beams = torch.stack([images.y - y, images.z - z]) / -x
    return np.stack([change_by_flow(best, make.dt * one * beams) for one in swirl], -1)
