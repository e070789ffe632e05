"""A pair of vortices from two images and an expected pair: a few steps in place of a search."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.retrieval.likelihood.scoring import inverse_of
from lidar_mi.retrieval.vortices.acceptance import Limits, within
from lidar_mi.retrieval.vortices.ambient import Ambient, AmbientWind, in_ambient_wind
from lidar_mi.retrieval.vortices.covariance import model_error_of
from lidar_mi.retrieval.vortices.images import SAME_BRIGHTNESS, Builder, Images, Path, View
from lidar_mi.retrieval.vortices.model_error import ModelError
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.robust_fit import Misfit, residual_after, stepped, without_step

# Blur and step between the pixels used (px), and the expected error of displacements (px) that they
# are for: images of texture 3 px long agree by chance with themselves moved by more.
_LEVELS = ((3.0, 4, 2.0), (1.5, 2, 0.7), (0.0, 2, 0.2))
# Of the fit itself.
_WHITE = (0.0, 1)
# Points along each axis at which the expected error of the displacements is looked at.
_PROBES = 15
# Standard deviation of the model error assumed at first, px.
_MODEL_ERROR = 0.1
# Length (px) over which an image's slope changes, as far as steps are concerned: a displacement d
# that is linearised leaves an error of d^2 over it.
_CURVED = 3.0
# Displacement (px, rms over the image: near a core ten times as much) to which every second pixel
# of the filtered images is warped, at most so often.
_CLOSE, _STEPS = 0.05, 4
# Largest error of the last step by curvature, in standard errors of all parameters together,
# without the part that is corrected near the cores; the unfiltered images are warped at most so
# often.
_CURVATURE_ERROR, _ROUNDS = 0.1, 6
# Change of the ambient wind's displacements (px, rms) for which the images are warped again.
_AMBIENT = 0.1
# Rms normalised difference of fit and start beyond which one of them is wrong.
_REJECTED = 4.0


class NearbyFit(NamedTuple):
    """A solution in its ambient wind, its images, their unwhitened misfit, the model error."""

    ambient: Ambient
    images: Images
    unwhitened: Misfit
    error: ModelError


@dataclass(frozen=True, eq=False)
class StartedFit:
    """A fit near an expected pair that lacks its second image; see `start_fit`.

    theta (16,): parameters of the start.
    uncertain: of the displacements at the start, px.
    make: of the first image, with the filter of both.
    first: the first image, unblurred, at the start.
    second: of the air to the second one.
    """

    start: VortexPairFit
    theta: torch.Tensor
    uncertain: float
    make: Builder
    first: View
    second: Path


def start_fit(start: VortexPairFit, make: Builder, limits: Limits) -> StartedFit | None:
    """The part of `fit_from` that needs the expected pair and the first image, that of `make`.

    None if no fit starts there.
    """
    if not np.isfinite(start.parameters).all() or not np.isfinite(start.covariance).all():
        return None
    theta = torch.tensor([*start.parameters, *SAME_BRIGHTNESS], dtype=torch.float64)
    theta = theta.to(make.pair.device)
    if not limits(theta, torch.zeros_like(theta)):
        return None
    make = replace(make, ambient=start.ambient)
    white = make(*_WHITE)
    to_first, to_second = white.paths(theta)
    first, uncertain = white.view(0, to_first), _displacement_error(start, make)
    make = replace(make, of_first=make.splines)
    return StartedFit(start, theta, uncertain, make, first, to_second)


def fit_from(started: StartedFit, make: Builder, limits: Limits, lags: float) -> NearbyFit | None:
    """The fit of `image_fit.fit_vortices` near an expected pair; None if there is none.

    Steps on blurred images come first if the start is uncertain, on every second pixel. Then the
    unfiltered images are warped once, and noise and change are estimated as without a start, with
    the start's model error if it has one; that of the fit is estimated from the residuals. The last
    step is linear, and so are its residuals.

    make: of both images.
    limits: (parameters, step) -> whether such a step may be tried.
    lags: over which the noise correlates, px.
    """
    known, error = (started.first, started.second), started.start.model_error * make.dt
    departure = error**2 if np.isfinite(error) else None
    return fit_near(
        started.theta, make, limits, lags, started.uncertain, known=known, departure=departure
    )


def fit_near(
    theta: torch.Tensor,
    make: Builder,
    limits: Limits,
    lags: float,
    uncertain: float = _LEVELS[-1][-1],
    estimates: int = 1,
    known: tuple[View, Path] | None = None,
    departure: float | None = None,
) -> NearbyFit | None:
    """`fit_from` parameters (16,) whose displacements are uncertain by so many px.

    Noise, change and model error are estimated so many times, each with the filter and the weights
    of the time before. The view of the first image and the path to the second may be `known`, and
    the variance (m^2) of the flow's `departure` from the model, as of the previous slab: it is then
    estimated for the errors alone.
    """
    variance = (_MODEL_ERROR * (make.spacing[0] * make.spacing[1]) ** 0.5) ** 2
    for blur, stride, least in _LEVELS:
        if uncertain < least:
            continue
        known = None
        thin = make(blur, stride)
        # differences of filtered images are less accurate, but enough for a start
        thin = replace(thin, whole=thin.spline)
        for _ in range(_STEPS):
            misfit = thin(theta)
            images = thin.at_least(_linear_power(misfit, variance))
            near = within(limits, theta, stepped(theta, images.weighted(misfit), variance))
            if near is None:
                return None
            far = _displaced(near.parameters - theta, misfit, make)
            theta = near.parameters
            # blurred images need not be nearer than their own resolution
            if far < _CLOSE * max(1.0, 2 * blur):
                break
    white, close = make(*_WHITE), False
    for _ in range(_ROUNDS):
        views = [known[0], white.view(1, known[1])] if known else white.views(theta)
        misfit, known = white.misfit(theta, views), None
        # before an estimate of change the weights are of all residuals, as of white noise
        images = white.at_least(_linear_power(misfit, variance))
        plain = within(limits, theta, stepped(theta, images.weighted(misfit), variance))
        if plain is None:
            return None
        # where air changes, the weights of the estimates below lead elsewhere
        if not close and (
            _curvature_error(plain.fisher, plain.parameters - theta, misfit, make)
            > _CURVATURE_ERROR
        ):
            theta = plain.parameters
            continue
        close = True
        # near the cores paths are not linear in the step: the only second-order term needed
        beyond = white.curved(misfit, views, theta, plain.parameters)
        misfit = misfit._replace(residual=misfit.residual + beyond)
        corrected = plain.misfit._replace(residual=plain.misfit.residual + beyond)
        solution = plain._replace(misfit=corrected)
        for _ in range(estimates):
            moves = departure
            if moves is None:
                moves = model_error_of(solution, lags, changes=True).variance
            images = make.with_change(white, images, solution.misfit, moves)
            if not images.passed > 0:
                return None
            near = within(limits, theta, stepped(theta, images.whitened(misfit), moves))
            if near is None:
                return None
            solution = near
        ambient = in_ambient_wind(solution, white.y, white.z, make.dt, white.ambient)
        reached = ambient.solution.parameters[: len(theta)]
        step = reached - theta
        if not limits(theta, step):
            return None
        change = _change(white, ambient.wind) * make.dt
        far = float(change.square().mean().sqrt()) / min(make.spacing)
        curved = _curvature_error(solution.fisher, step, misfit, make)
        if far < _AMBIENT and curved < _CURVATURE_ERROR:
            error = model_error_of(ambient.solution, lags, changes=True)
            remaining = residual_after(misfit, step) + (misfit.slope * change).sum(0)
            return NearbyFit(ambient, images, misfit._replace(residual=remaining), error)
        white = replace(white, ambient=ambient.wind)
        theta, variance = reached, moves
    return None


def _change(images: Images, wind: AmbientWind) -> torch.Tensor:
    """Change (2, z, y) of the ambient wind at the pixels, m/s."""
    change = wind.at(images.y, images.z)
    return change if images.ambient is None else change - images.ambient.at(images.y, images.z)


def _curvature_error(
    normal: torch.Tensor, step: torch.Tensor, misfit: Misfit, make: Builder
) -> float:
    """Standard errors that a linear step may be off by curvature."""
    far = _displaced(step, misfit, make) / _CURVED
    return float(step @ normal @ step) ** 0.5 * far


def _displaced(step: torch.Tensor, misfit: Misfit, make: Builder) -> float:
    """Rms displacement (px) of the images by a step, along their slopes."""
    change = residual_after(misfit, step) - misfit.residual
    ratio = 2 * change.square().sum() / misfit.slope.square().sum()
    return float(ratio.sqrt()) / min(make.spacing)


def _linear_power(misfit: Misfit, variance: float) -> float:
    """Mean square of the residuals after a linear step to the minimum."""
    return float(without_step(misfit, variance)[misfit.valid].square().mean())


def agrees(start: VortexPairFit, fit: VortexPairFit) -> bool:
    """Whether a fit agrees with the start within both errors."""
    off = fit.parameters - start.parameters
    inverse = inverse_of(torch.as_tensor(fit.covariance + start.covariance)).numpy()
    return float(off @ inverse @ off) < _REJECTED**2 * len(off)


def _displacement_error(start: VortexPairFit, make: Builder) -> float:
    """Standard error, px, of the start's displacements over the images, where it is large."""
    places = [np.linspace(axis[0], axis[-1], _PROBES) for axis in (make.y, make.z)]
    # the air's departure from the model is no error of the start
    _, spread = replace(start, model_error=0.0, ambient=None).wind_and_covariance(
        places[0][None, :], places[1][:, None]
    )
    px = make.dt / min(make.spacing)
    return float(np.sqrt(np.quantile(spread[:2].max(0), 0.9))) * px
