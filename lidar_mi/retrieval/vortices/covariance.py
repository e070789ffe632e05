"""Covariance of fitted parameters: from noise, model error and incomplete convergence."""

import numpy as np
import torch

from lidar_mi.retrieval.images.windows import averaged
from lidar_mi.retrieval.likelihood.scoring import inverse_of
from lidar_mi.retrieval.vortices.ambient import ALONG, AmbientErrors
from lidar_mi.retrieval.vortices.model_error import (
    ModelError,
    Response,
    model_error,
    of_change,
    spread_of,
)
from lidar_mi.retrieval.vortices.robust_fit import Solution, score_of

# Width (px) of the Gaussian over which squared residuals are averaged.
_NEAR = 12.0
# Side of the blocks (px) whose means are independent, the least number of them, and standard
# errors by which an increase between them is significant.
_BLOCK, _FEW_BLOCKS, _SIGNIFICANT = 12, 12, 4.0
# Least curvature of the misfit over that by the slopes, that of images with little in common.
_LEAST_CURVATURE = 0.1


def model_error_of(
    solution: Solution, shortest: float, *, changes: bool = False, before: ModelError | None = None
) -> ModelError:
    """Departure of the flow from the model, from the residuals of a fit; see `model_error`.

    It is the departure in the residuals. With `before`, that departure as returned by this
    function, it is the departure itself. With `changes`, residuals (z, y) may correlate for another
    reason, see `of_change`.

    Each force then counts by the inverse of its variance in the waves of the departure that was
    found first: by noise A, by the departure A^2 times its spectral density, with A the mean
    stiffness around. So where the Fisher information is large, all places have equal weight. Else
    the places of the steepest smoke would represent the whole image, and the departure would be too
    large where it grows there.
    """
    if changes and before is not None and not before.variances:
        return before
    misfit = solution.misfit
    residual, slope, weight = misfit.residual, misfit.slope, solution.weight
    if residual.ndim == 2:
        residual, slope, weight = residual[None], slope[:, None], weight[None]
    force = (slope * weight * residual).sum(1)
    stiffness = torch.stack(
        [(weight * slope[a] * slope[b]).sum(0) for a, b in ((0, 0), (0, 1), (1, 1))]
    )
    # residuals lack the part of the departure that the parameters have followed
    follow = (_responses(solution), inverse_of(solution.fisher)) if before is not None else None

    def of_forces(even: torch.Tensor | float, tested: bool) -> ModelError:
        change, response = None, follow and Response(*follow, even)
        if changes:
            steep = even * solution.weight * misfit.slope
            change = of_change(misfit.residual, steep, misfit.valid)
        return model_error(even * force, even * stiffness, shortest, change, response, tested)

    first = before if changes and before is not None else of_forces(1.0, True)
    if not changes or not first.variances:
        return first
    # mean of both components, over places that one wave of the departure covers
    information = averaged(stiffness[0] + stiffness[2], misfit.valid, _NEAR / 2) / 2
    again = of_forces(1 / (1 + first.density * information), False)
    return again if again.variances else first


def parameter_covariance(
    solution: Solution,
    residual_error: ModelError,
    departure: ModelError,
    excess: float,
    ambient: torch.Tensor,
) -> np.ndarray:
    """Covariance (10, 10): H^-1 M H^-1, M that of the force by noise and by the flow's departure.

    And that by the ambient wind (10, 10).

    The part by noise is multiplied by `excess`: for H of noisy slopes, 1 / `curvature`^2. The part
    of the departure in the residuals is `residual_error`.
    """
    spread = _noise_spread(solution, residual_error).double() * excess
    spread = spread + spread_of(_responses(solution), departure).double()
    # the sandwich: its errors hold although the weights are not the inverse covariance
    inverse = inverse_of(solution.fisher)
    covariance = (inverse @ spread @ inverse)[:10, :10] + ambient
    attenuation = _attenuation(solution)
    # a bias of unknown size: fully correlated between the parameters
    covariance = covariance + torch.outer(attenuation, attenuation)
    if not solution.converged:
        remaining = _remaining_step(solution)
        covariance = covariance + torch.outer(remaining, remaining)
    return covariance.cpu().numpy()


def shared_error(errors: AmbientErrors) -> tuple[np.ndarray, float]:
    """Covariance (10, 10) of the parameters' error by the ambient wind, and its length along x, m.

    The length is that of an exponential with the mean of the parameters' correlations at `ALONG`.
    """
    here, ahead = (part.cpu().numpy() for part in (errors.covariance, errors.ahead))
    correlation = float(np.clip((np.diagonal(ahead) / np.diagonal(here)).mean(), 1e-6, 1 - 1e-6))
    return here, -ALONG / np.log(correlation)


def _responses(solution: Solution) -> torch.Tensor:
    """Force (p, 2, z, y) on the parameters by a displacement (m/s of vectors) of the flow."""
    misfit, weight = solution.misfit, solution.weight
    if weight.ndim == 2:
        return weight * misfit.jacobian[:, None] * misfit.slope
    return torch.einsum("ozy,pozy,aozy->pazy", weight, misfit.jacobian, misfit.slope)


def curvature(solution: Solution, spacing: tuple[float, float]) -> float:
    """Curvature of the misfit of two images over that by the slopes alone, from 0 to 1.

    The mean of both images' slopes has noise and change of its own, which are half of the slopes of
    the residual: the second derivative of a residual r by a shift is a quarter of its own, and so
    of the sum of r^2 it takes a quarter of the sum of its squared slopes. Images of nothing in
    common have a slope of their mean, but no minimum.

    solution: of images (z, y).
    spacing: of the pixels along y and z, m.
    """
    residual, weight = solution.misfit.residual, solution.weight
    steep = 0.0
    for step, axis in zip(spacing, (1, 0), strict=True):
        # half way between pixels, to the fourth order
        r0, r1, r2, r3 = _neighbours(residual, axis)
        change = (27 * (r2 - r1) - (r3 - r0)) / (24 * step)
        least = torch.stack(_neighbours(weight, axis)).amin(0)
        steep += float((least * change.square()).sum())
    whole = float((weight * solution.misfit.slope.square().sum(0)).sum())
    # below the least curvature the images have no minimum to be certain of
    return max(1 - steep / (4 * whole), _LEAST_CURVATURE) if whole > 0 else 1.0


def _neighbours(field: torch.Tensor, axis: int) -> list[torch.Tensor]:
    """Four successive values along an axis."""
    number = field.shape[axis] - 3
    return [field.narrow(axis, first, number) for first in range(4)]


def change_by_flow(solution: Solution, flow: torch.Tensor) -> np.ndarray:
    """Change (10,) of the parameters by a small flow that the model does not have.

    flow (2, z, y): along y and z: displacements (m) of images, winds (m/s) of vectors, at the
        residuals.
    """
    misfit = solution.misfit
    flow = flow if misfit.slope.ndim == 3 else flow[:, None]
    change = (misfit.slope * flow.to(misfit.slope)).sum(0)
    score = score_of(misfit._replace(residual=change), solution.weight)
    return -(inverse_of(solution.fisher) @ score)[:10].cpu().numpy()


def _noise_spread(solution: Solution, error: ModelError) -> torch.Tensor:
    """Covariance of the force by noise: from the residuals, of vectors if it exceeds that stated.

    By the residuals, each stands for its own variance (White 1980, Econometrica 48, 817), whatever
    pixels are noisier than stated. Of images it is their mean about each pixel: ten parameters
    absorb part of the few residuals in a core.
    """
    misfit, weight = solution.misfit, solution.weight
    columns = misfit.jacobian.flatten(1)
    by_flow = error.variance * misfit.slope.square().sum(0)
    ratio = (misfit.residual.square() / (misfit.scatter + by_flow)).where(misfit.valid, 0.0)
    if ratio.ndim == 2:
        ratio = averaged(ratio, misfit.valid, _NEAR)
        return (columns * (weight**2 * misfit.variance * ratio).flatten()) @ columns.T
    stated, observed = (
        (columns * (weight**2 * part).flatten()) @ columns.T
        for part in (misfit.variance, misfit.variance * ratio)
    )
    scale = solution.fisher.diagonal()
    excess = float((observed.diagonal() / scale).sum() / (stated.diagonal() / scale).sum())
    return observed if excess > 1 else stated


def _remaining_step(solution: Solution) -> torch.Tensor:
    """The remaining step (10,) of a fit that interpolation noise has stopped."""
    return (inverse_of(solution.fisher) @ solution.score)[:10]


def far_from_minimum(solution: Solution, covariance: np.ndarray) -> bool:
    """Whether the remaining step is more than the other standard error of any parameter."""
    square = _remaining_step(solution).cpu().numpy() ** 2
    # the remaining step is part of the covariance: it is compared with the rest
    return not (square < np.diagonal(covariance) - square).all()


def _attenuation(solution: Solution) -> torch.Tensor:
    """Possible bias of the circulations towards zero, as an error of all parameters (10,).

    Structure that has been wound up for long is aligned with the flow: the images change little,
    and the residual may as well be model error. Non-advected structure changes less
    than the air does. The inverse regression (errors in the model, not in the change) would
    make both circulations larger by the unexplained fraction of the change: this is the error
    stated. The unexplained part of images counts only as far as it grows with the change, as air is
    replaced anywhere.
    """
    misfit, theta = solution.misfit, solution.parameters
    explained = (theta[0] * misfit.jacobian[0] + theta[4] * misfit.jacobian[4]).square()
    square = misfit.residual.square()
    if square.ndim == 2:
        # of images: model error leaves residuals in slow air as well, which are no attenuation
        steep = misfit.slope.square().sum(0)
        fraction = _increase(square - misfit.scatter, explained, steep, misfit.valid)
    else:
        power = float((solution.weight * explained)[misfit.valid].sum())
        excess = float((solution.weight * (square - misfit.scatter))[misfit.valid].sum())
        fraction = max(0.0, excess / power) if power > 0 else 0.0
    attenuation = torch.zeros_like(theta[:10])
    attenuation[0], attenuation[4] = fraction * theta[0], fraction * theta[4]
    return attenuation


def _increase(
    excess: torch.Tensor, explained: torch.Tensor, steep: torch.Tensor, valid: torch.Tensor
) -> float:
    """Increase of the misfit per explained change, of means over blocks; 0 if not significant.

    The smaller one of that of the means and of that of the means over their squared slopes. Bright
    air has more of misfit, change and slopes, and so increases the first; where the model fits
    worse in fast air of little texture, the second is increased.
    """
    whole = valid.to(excess)
    sums = torch.nn.functional.avg_pool2d(
        torch.stack([whole, whole * excess, whole * explained, whole * steep])[:, None],
        min(_BLOCK, *excess.shape),
    ).flatten(1)
    full = (sums[0] > 0.5) & (sums[3] > 0)
    if int(full.sum()) < _FEW_BLOCKS:
        return 0.0
    part, misfit, change, power = sums[:, full]
    return min(
        _slope(misfit / part, change / part, torch.ones_like(part)),
        _slope(misfit / power, change / power, power),
    )


def _slope(misfit: torch.Tensor, change: torch.Tensor, weight: torch.Tensor) -> float:
    """Of a weighted straight line; 0 if not significant by residuals of any size (White 1980)."""
    weight = weight / weight.sum()
    misfit, change = (part - (weight * part).sum() for part in (misfit, change))
    square = (weight * change.square()).sum()
    if not float(square) > 0:
        return 0.0
    slope = float((weight * change * misfit).sum() / square)
    residual = misfit - slope * change
    error = float((weight * change * residual).square().sum().sqrt() / square)
    return slope if slope > _SIGNIFICANT * error else 0.0
