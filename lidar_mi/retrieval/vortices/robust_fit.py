"""Weighted nonlinear least squares with a bounded influence of outliers (Levenberg-Marquardt)."""

from collections.abc import Callable
from typing import NamedTuple

import torch

# Residuals beyond so many standard deviations have the influence of those at it (Huber, 1964),
# which loses 0.1 % of the information with normal noise.
_HUBER = 3.0
_LARGEST_DAMPING = 1e4
# Squared standard errors from the minimum that a fit may stop at.
_NEAR = 0.1


class Misfit(NamedTuple):
    """Residuals of a model and their derivatives, tensors of shape (..., z, y).

    Attributes
    ----------
    residual : torch.Tensor
    jacobian : torch.Tensor, shape (p, ..., z, y)
        Derivatives of the residual with respect to the parameters.
    slope : torch.Tensor, shape (2, ..., z, y)
        Change of the residual per metre (per m/s) of the model flow's error along y, z.
    valid : torch.Tensor of bool
        Which residuals exist.
    variance : torch.Tensor
        Of the noise, for its effect on the parameters.
    scatter : torch.Tensor
        Of the noise in a residual (less than `variance` after a filter).
    """

    residual: torch.Tensor
    jacobian: torch.Tensor
    slope: torch.Tensor
    valid: torch.Tensor
    variance: torch.Tensor
    scatter: torch.Tensor


class Solution(NamedTuple):
    """Result of a fit: parameters (p,), the misfit there, its weights, sum of w J J^T."""

    parameters: torch.Tensor
    misfit: Misfit
    weight: torch.Tensor
    normal: torch.Tensor
    cost: float
    converged: bool


def weights(misfit: Misfit, flow_variance: float) -> torch.Tensor:
    """1 / variance of noise and model error, less for outliers; 0 where there is no residual."""
    by_flow = flow_variance * misfit.slope.square().sum(0)
    size = misfit.residual.abs() / (misfit.scatter + by_flow).sqrt()
    return misfit.valid * (_HUBER / size.clamp(min=_HUBER)) / (misfit.variance + by_flow)


def without_step(misfit: Misfit, flow_variance: float) -> torch.Tensor:
    """The residuals that a linear step to the minimum would leave."""
    normal, force = _normal(misfit, weights(misfit, flow_variance))
    step = _step(normal, force, 1e-6)
    if step is None:
        return misfit.residual
    return residual_after(misfit, step)


def residual_after(misfit: Misfit, step: torch.Tensor) -> torch.Tensor:
    """The residuals after a step, to first order."""
    return misfit.residual + torch.tensordot(step.to(misfit.residual), misfit.jacobian, 1)


def stepped(
    parameters: torch.Tensor, misfit: Misfit, flow_variance: float, iterations: int = 2
) -> Solution | None:
    """The minimum of residuals that are linear in the parameters, None if there is none.

    The weights are those of the remaining residuals: each iteration after the first corrects the
    step with the weights of the residuals before it and the first iteration's matrix.
    """
    weight = weights(misfit, flow_variance)
    normal, force = _normal(misfit, weight)
    step, remaining = torch.zeros_like(force), misfit
    for iteration in range(iterations):
        if iteration:
            force = _force(remaining, weights(remaining, flow_variance))
        correction = _step(normal, force, 1e-6)
        if correction is None:
            return None
        step = step + correction
        remaining = misfit._replace(residual=residual_after(misfit, step))
    return _solution(parameters + step, remaining, flow_variance, True)


def fit(
    evaluate: Callable[[torch.Tensor], Misfit],
    parameters: torch.Tensor,
    allowed: Callable[[torch.Tensor, torch.Tensor], bool],
    flow_variance: float,
    iterations: int,
    tolerance: float,
) -> Solution:
    """Minimise the weighted squares of the residuals.

    Parameters
    ----------
    evaluate : callable
        Parameters (p,) -> Misfit.
    parameters : torch.Tensor, shape (p,)
        Starting point.
    allowed : callable
        (parameters, step) -> whether such a step may be tried.
    flow_variance : float
        Of the model error in each component; adds to the noise through `slope`.
    iterations : int
        At most.
    tolerance : float
        Stop at a step of so many standard errors, squared.
    """
    damping = 1e-4
    misfit = evaluate(parameters)
    for _ in range(iterations):
        weight = weights(misfit, flow_variance)
        normal, force = _normal(misfit, weight)
        while True:
            step = _step(normal, force, damping)
            if step is not None and allowed(parameters, step):
                tried = evaluate(parameters + step)
                # in squared standard errors; a damped step is short without being near
                if float(step @ normal @ step) < tolerance and damping < 1:
                    return _solution(parameters + step, tried, flow_variance, True)
                # of the same residuals: others would change the cost by themselves
                both = misfit.valid & tried.valid
                before, after = (
                    float((weight * m.residual.square())[both].sum()) for m in (misfit, tried)
                )
                # derivatives are approximate: a cost that rises by less than the noise is accepted
                if after <= before + tolerance and bool(both.any()):
                    break
            damping = 8 * max(damping, 1e-4)
            if damping > _LARGEST_DAMPING:
                # no step lowers the cost: converged if the step would have been short
                step = _step(normal, force, 1e-6)
                near = step is not None and float(step @ normal @ step) < _NEAR
                return _solution(parameters, misfit, flow_variance, near)
        damping /= 8
        parameters, misfit = parameters + step, tried
    return _solution(parameters, misfit, flow_variance, False)


def _normal(misfit: Misfit, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sums of w J J^T and of -w J r."""
    columns = misfit.jacobian.flatten(1)
    weighted = columns * weight.flatten()
    return (weighted @ columns.T).double(), _force(misfit, weight)


def _force(misfit: Misfit, weight: torch.Tensor) -> torch.Tensor:
    """Sum of -w J r."""
    return -(misfit.jacobian.flatten(1) @ (weight * misfit.residual).flatten()).double()


def _step(normal: torch.Tensor, force: torch.Tensor, damping: float) -> torch.Tensor | None:
    diagonal = normal.diagonal()
    if not bool((diagonal > 0).all()):
        return None
    # in proportion to the diagonal, as every parameter has a unit of its own (Marquardt)
    root, info = torch.linalg.cholesky_ex(normal + damping * torch.diag(diagonal))
    if int(info):
        return None
    step = torch.cholesky_solve(force[:, None], root)[:, 0]
    return step if bool(torch.isfinite(step).all()) else None


def _solution(
    parameters: torch.Tensor, misfit: Misfit, flow_variance: float, converged: bool
) -> Solution:
    weight = weights(misfit, flow_variance)
    normal, _ = _normal(misfit, weight)
    number = max(1, int(misfit.valid.sum()))
    cost = float((weight * misfit.residual.square()).sum()) / number
    return Solution(parameters, misfit, weight, normal, cost, converged)
