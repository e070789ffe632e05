"""Fisher information, and scoring: the most probable parameters of many independent fits at once.

Weighted least squares whose weights come from the mean of the step before (Fisher 1925, Proc. Camb.
Philos. Soc. 22, 700-725). Where the steps end the score is 0: it is the maximum of the likelihood
times the priors, and the inverse of the Fisher matrix is the covariance there.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import torch

from lidar_mi.errors import InputError

# Of a matrix with a unit diagonal, in double precision: beyond, its inverse is rounding.
_WORST_CONDITION = 1e13

T = TypeVar("T")


def fisher_matrix(
    jacobian: torch.Tensor, weight: torch.Tensor, free: Sequence[int] | None = None
) -> torch.Tensor:
    """sum_i w_i J_i J_i^T over the free parameters (all if None), (fits, free, free)."""
    part = jacobian if free is None else jacobian[:, list(free)]
    return (part * weight[:, None]) @ part.transpose(1, 2)


def standard_deviations(fisher: torch.Tensor) -> torch.Tensor:
    """Roots of the diagonal of the inverse, NaN where there is none, shape (fits, free).

    Matrices that only rounding makes invertible have none.
    """
    scaled, scale = _unit_diagonal(fisher)
    inverse, info = torch.linalg.inv_ex(scaled)
    condition = torch.linalg.matrix_norm(scaled, 1) * torch.linalg.matrix_norm(inverse, 1)
    deviation = inverse.diagonal(dim1=1, dim2=2).sqrt() * scale
    determined = (info == 0) & (condition < _WORST_CONDITION)
    return torch.where(determined[:, None], deviation, torch.nan)


class Limits(NamedTuple):
    """When scoring ends.

    Attributes
    ----------
    longest : torch.Tensor, shape (free,)
        Longest step of each parameter: a longer one leaves the range in which the mean is linear.
    close : float
        Largest last step of a fit that has converged, standard deviations.
    steps : int
    """

    longest: torch.Tensor
    close: float
    steps: int


class Fits(NamedTuple):
    """What is fitted, for messages: ``name[first]`` is the first, and what is expected of it."""

    name: str
    first: int
    expected: tuple[str, str]


def scoring(
    expanded: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor, T]],
    advanced: Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor | None]],
    parameters: torch.Tensor,
    limits: Limits,
    fits: Fits,
) -> tuple[torch.Tensor, torch.Tensor, T]:
    """The parameters (fits, all) where the score is 0, the Fisher matrices there, and the rest.

    Parameters
    ----------
    expanded : callable
        From parameters to the Fisher matrices (fits, free, free) and scores (fits, free) of
        likelihood and priors, and whatever else the caller needs of the end.
    advanced : callable
        From parameters and a step (fits, free) to the next parameters inside their bounds, and to
        which fits have ended at one of them, if any may.

    Raises
    ------
    InputError
        A step that is not finite, fits that have not converged.
    """
    converged = torch.zeros(len(parameters), dtype=torch.bool, device=parameters.device)
    for _ in range(limits.steps):
        fisher, score, rest = expanded(parameters)
        if converged.all():
            return parameters, fisher, rest
        # parameters of different units differ by powers of ten
        scaled, scale = _unit_diagonal(fisher)
        step = torch.linalg.solve_ex(scaled, score * scale)[0] * scale
        lost = ~torch.isfinite(step).all(1)
        if lost.any():
            raise _refused(fits, lost, "the fit fails", fits.expected[0])
        converged = (step.abs() <= limits.close * standard_deviations(fisher)).all(1)
        parameters, ended = advanced(parameters, step.clamp(-limits.longest, limits.longest))
        if ended is not None:
            converged |= ended
    raise _refused(fits, ~converged, "the fit does not converge", fits.expected[1])


def _refused(fits: Fits, which: torch.Tensor, problem: str, expected: str) -> InputError:
    number = fits.first + int(which.nonzero()[0])
    return InputError(f"{fits.name}[{number}]: {problem}; expected {expected}")


def _unit_diagonal(fisher: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    scale = fisher.diagonal(dim1=1, dim2=2).rsqrt()
    return fisher * scale[:, :, None] * scale[:, None, :], scale
