"""Nonlinear least squares with a bounded influence of outliers (`likelihood.scoring`)."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch

from lidar_mi.retrieval.likelihood.scoring import damped_scoring, damped_step, fisher_matrix

# Residuals beyond so many standard deviations have the influence of those at it (Huber, 1964),
# which loses 0.1 % of the information with normal noise.
_HUBER = 3.0


class Misfit(NamedTuple):
    """Residuals of a model and their derivatives, tensors of shape (..., z, y).

    jacobian (p, ..., z, y): derivatives of the residual with respect to the parameters.
    slope (2, ..., z, y): change of the residual per metre (per m/s) of the model flow's error along
        y, z.
    valid: which residuals exist.
    variance: of the noise, for its effect on the parameters.
    scatter: of the noise in a residual (less than `variance` after a filter).
    """

    residual: torch.Tensor
    jacobian: torch.Tensor
    slope: torch.Tensor
    valid: torch.Tensor
    variance: torch.Tensor
    scatter: torch.Tensor


class Solution(NamedTuple):
    """Result of a fit: parameters (p,), the misfit there, its weights, the Fisher matrix."""

    parameters: torch.Tensor
    misfit: Misfit
    weight: torch.Tensor
    fisher: torch.Tensor
    cost: float
    converged: bool

    @property
    def score(self) -> torch.Tensor:
        """Sum of -w J r, (p,)."""
        return score_of(self.misfit, self.weight)


def weights(misfit: Misfit, flow_variance: float) -> torch.Tensor:
    """1 / variance of noise and model error, less for outliers; 0 where there is no residual."""
    by_flow = flow_variance * misfit.slope.square().sum(0)
    size = misfit.residual.abs() / (misfit.scatter + by_flow).sqrt()
    return misfit.valid * (_HUBER / size.clamp(min=_HUBER)) / (misfit.variance + by_flow)


def without_step(misfit: Misfit, flow_variance: float) -> torch.Tensor:
    """The residuals that a linear step to the minimum would leave."""
    weight = weights(misfit, flow_variance)
    step = damped_step(_fisher(misfit, weight), score_of(misfit, weight))
    return misfit.residual if step is None else residual_after(misfit, step)


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
    fisher = _fisher(misfit, weight)
    step, remaining = torch.zeros_like(fisher[0]), misfit
    for _ in range(iterations):
        correction = damped_step(fisher, score_of(remaining, weight))
        if correction is None:
            return None
        step = step + correction
        remaining = misfit._replace(residual=residual_after(misfit, step))
        weight = weights(remaining, flow_variance)
    return _solution(parameters + step, remaining, weight, True)


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

    def at(parameters: torch.Tensor) -> Solution:
        misfit = evaluate(parameters)
        return _solution(parameters, misfit, weights(misfit, flow_variance), False)

    def moved(last: Solution, step: torch.Tensor) -> Solution | None:
        return at(last.parameters + step) if allowed(last.parameters, step) else None

    def rise(last: Solution, tried: Solution) -> float:
        # of the same residuals: others would change the cost by themselves
        both = last.misfit.valid & tried.misfit.valid
        before, after = (
            float((last.weight * one.misfit.residual.square())[both].sum()) for one in (last, tried)
        )
        return after - before if bool(both.any()) else math.inf

    solution, converged = damped_scoring(at(parameters), moved, rise, iterations, tolerance)
    return solution._replace(converged=converged)


def score_of(misfit: Misfit, weight: torch.Tensor) -> torch.Tensor:
    """Sum of -w J r, (p,)."""
    return -(misfit.jacobian.flatten(1) @ (weight * misfit.residual).flatten()).double()


def _fisher(misfit: Misfit, weight: torch.Tensor) -> torch.Tensor:
    return fisher_matrix(misfit.jacobian.flatten(1), weight.flatten()).double()


def _solution(
    parameters: torch.Tensor, misfit: Misfit, weight: torch.Tensor, converged: bool
) -> Solution:
    number = max(1, int(misfit.valid.sum()))
    cost = float((weight * misfit.residual.square()).sum()) / number
    return Solution(parameters, misfit, weight, _fisher(misfit, weight), cost, converged)
