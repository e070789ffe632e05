"""Scoring: the most probable parameters, given residuals, their derivatives and priors.

With residuals r of n data, their derivatives J (parameters, n), weights w of their inverse
variances and the information P of a normal prior about m, the score and the Fisher information of
parameters x are

    s = -J w r + P (m - x),        F = J w J^T + P,

and -2 ln of likelihood times prior is r w r + (m - x) P (m - x) but for a constant. A step solves
(F + a diag F) dx = s, with weights of the point before (Fisher 1925, Proc. Camb. Philos. Soc. 22,
700-725). Where the steps end the score is 0: it is the maximum, and F^-1 is the covariance there.
`scoring` takes full steps, a = 0, of many independent fits at once; `damped_scoring` adapts a, of
fits that start far off (Levenberg 1944, Q. Appl. Math. 2, 164; Marquardt 1963, J. SIAM 11, 431).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch

from lidar_mi.errors import InputError

# Of a matrix with a unit diagonal, in double precision: beyond, its inverse is rounding.
_WORST_CONDITION = 1e13
# Damping: of the first step, factor after each one, largest.
_FIRST, _FACTOR, _LARGEST = 1e-4, 8.0, 1e4
# Squared standard errors from the maximum at which steps that gain nothing may end.
_NEAR = 0.1

T = TypeVar("T")


class Point(Protocol):
    """Parameters with likelihood times priors about them."""

    @property
    def parameters(self) -> torch.Tensor:
        """x, (p,)."""

    @property
    def fisher(self) -> torch.Tensor:
        """F, (p, p)."""

    @property
    def score(self) -> torch.Tensor:
        """s, (p,)."""


P = TypeVar("P", bound=Point)


def fisher_matrix(
    jacobian: torch.Tensor, weight: torch.Tensor, free: Sequence[int] | None = None
) -> torch.Tensor:
    """sum_i w_i J_i J_i^T over the free parameters (all if None), (..., free, free)."""
    part = jacobian if free is None else jacobian[..., list(free), :]
    return (part * weight[..., None, :]) @ part.mT


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


def inverse_of(fisher: torch.Tensor, rounding: float | None = None) -> torch.Tensor:
    """Pseudo-inverses of Fisher matrices (..., p, p) of parameters whose units differ.

    Eigenvalues of less than `rounding` (default: that of the type) of the largest count as 0.
    """
    scale = fisher.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    outer = scale[..., :, None] * scale[..., None, :]
    return torch.linalg.pinv(fisher * outer, rtol=rounding, hermitian=True) * outer


def damped_step(
    fisher: torch.Tensor, score: torch.Tensor, damping: float = 1e-6
) -> torch.Tensor | None:
    """The step (p,) of a damping; None where there is none."""
    scaled, scale = _unit_diagonal(fisher)
    root, info = torch.linalg.cholesky_ex(scaled + damping * torch.eye(len(scale)).to(scaled))
    step = torch.cholesky_solve((score * scale)[:, None], root)[:, 0] * scale
    return step if not int(info) and bool(torch.isfinite(step).all()) else None


def damped_scoring(
    point: P,
    moved: Callable[[P, torch.Tensor], P | None],
    rise: Callable[[P, P], float],
    steps: int,
    tolerance: float,
) -> tuple[P, bool]:
    """The point that damped steps lead to, and whether they have converged.

    point: start.
    moved: the point after a step (p,), or None: such a step may not be tried.
    rise: of -2 ln likelihood from one point to another, of the same data.
    steps: at most.
    tolerance: stop at a step of so many standard errors, squared, or at a short one that changes -2
        ln likelihood by less.
    """
    damping = _FIRST
    for _ in range(steps):
        fisher, score = point.fisher, point.score
        while True:
            step = damped_step(fisher, score, damping)
            tried = None if step is None else moved(point, step)
            if tried is not None:
                taken = tried.parameters - point.parameters
                square, risen = float(taken @ fisher @ taken), rise(point, tried)
                # a damped step is short without being near
                if damping < 1 and (
                    square < tolerance or (square < _NEAR and abs(risen) < tolerance)
                ):
                    return tried, True
                # derivatives may be approximate: a rise by less than the noise is accepted
                if risen <= tolerance:
                    break
            damping = _FACTOR * max(damping, _FIRST)
            if damping > _LARGEST:
                # no step leads up: converged if the step would have been short
                step = damped_step(fisher, score)
                return point, step is not None and float(step @ fisher @ step) < _NEAR
        damping, point = damping / _FACTOR, tried
    return point, False


class Limits(NamedTuple):
    """When scoring ends.

    longest (free,): longest step of each parameter: a longer one leaves the range in which the mean
        is linear.
    close: largest last step of a fit that has converged, standard deviations.
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

    expanded: from parameters to the Fisher matrices (fits, free, free) and scores (fits, free) of
        likelihood and priors, and whatever else the caller needs of the end.
    advanced: from parameters and a step (fits, free) to the next parameters inside their bounds,
        and to which fits have ended at one of them, if any may.

    Raises InputError: a step that is not finite, fits that have not converged.
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
    scale = fisher.diagonal(dim1=-2, dim2=-1).rsqrt()
    return fisher * scale[..., :, None] * scale[..., None, :], scale
