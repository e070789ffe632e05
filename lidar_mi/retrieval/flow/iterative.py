"""The flow in a volume, solved by conjugate gradients; posterior covariance from random draws.

The matrix is never stored. Solutions for random right-hand sides whose covariance is the
second derivative are flows drawn from the posterior (Papandreou & Yuille 2010, NIPS 23).
"""

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import linear_weights, separable

Linearly = Callable[[torch.Tensor], torch.Tensor]


class Posterior(NamedTuple):
    """A flow after a Gauss-Newton step, with the terms of its posterior.

    curvature (components, components, *prior.mesh.shape): the information of the volumes, lumped to
        the prior's mesh.
    single: the same in the precision of the voxels, which is enough for draws.
    iteration: seeds the draws.
    informed: the information of every voxel times coefficients (n, components, knots).
    response: see `variational.Posterior`: of volumes it would take a solution for every random
        field.
    """

    coefficients: torch.Tensor
    curvature: torch.Tensor
    prior: Prior
    single: Prior
    settings: VariationalSettings
    iteration: int
    informed: Linearly
    response: None = None

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: prior less posterior variance, and its square in the flow."""
        solver = self.settings.solver
        before, after = (
            self.single.by_kind(self.single.rates(flows).square()).mean(0)
            for flows in self._drawn(solver.draws, True, solver.loose, solver.steps)
        )
        energy = self.prior.by_kind(self.prior.rates(self.coefficients).square())
        # added to both, as the draws have sampling noise
        more = solver.damping * before
        # means over a few draws may differ with the wrong sign
        return (before - after).clamp(min=0) + more, energy + more

    def prior_gradient(self, flows: torch.Tensor) -> torch.Tensor:
        """The prior's precision times coefficients (n, components, knots)."""
        return _stiff(flows.to(self.prior.local), self.prior, self.settings.ridge)

    def fitted(self, gradients: torch.Tensor, strength: float = 1.0) -> torch.Tensor:
        """Coefficients by gradients (n, ...), with the prior's precision times a strength."""
        weaker, ridge = (
            self.single._replace(local=strength * self.single.local),
            self.settings.ridge,
        )
        ready = _preconditioner(self.curvature.to(weaker.local), weaker, ridge)
        solution = conjugate_gradients(
            lambda c: self.informed(c) + _stiff(c, weaker, ridge),
            gradients.to(weaker.local),
            ready,
            # what the prior does to a flow is smooth: a loose solution lacks it
            self.settings.solver.tolerance,
            self.settings.solver.steps,
        )
        return solution.to(gradients)

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before.

        A mean over flows drawn and over the width of the prior, accurate to some 10 %. Before the
        images it is infinite: the prior leaves rigid motion free.
        """
        solver = self.settings.solver
        exact = solver.final_tolerance, solver.final_steps
        (flows,) = self._drawn(solver.final_draws, False, *exact)
        flows = self.single.mesh.field(flows).to(self.prior.local)
        mean = self.prior.smooth((flows[:, :, None] * flows[:, None]).mean(0))
        after = interpolated(mean, self.prior.mesh.places, [p.to(mean) for p in places])
        return after, torch.full_like(after, torch.inf)

    def _drawn(self, number: int, before: bool, tolerance: float, steps: int) -> list[torch.Tensor]:
        """Flows (number, components, knots) drawn from the prior, if wanted, and the posterior.

        Both from the same random numbers: they are equal where the volumes inform nothing.
        """
        prior, ridge = self.single, self.settings.ridge
        like = self.coefficients.to(prior.local)
        draw = torch.Generator(device=like.device)
        # other draws in every round, the same ones in every run
        draw.manual_seed(self.settings.solver.seed + self.iteration)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(number, *shape, generator=draw, dtype=like.dtype, device=like.device)

        # right-hand sides whose covariance is the second derivative
        weights = prior.weights
        right = prior.rates_transposed(weights.sqrt() * normal(*weights.shape))
        right = right + ridge**0.5 * normal(*like.shape)
        curvature = self.curvature.to(like)
        flows = []
        if before:
            flows = [self._flows(torch.zeros_like(curvature), right, tolerance, steps)]
        root = _root(curvature)
        right = right + prior.mesh.transposed(_times(root, normal(len(root), *prior.mesh.shape)))
        return [*flows, self._flows(curvature, right, tolerance, steps)]

    def _flows(
        self, curvature: torch.Tensor, right: torch.Tensor, tolerance: float, steps: int
    ) -> torch.Tensor:
        mesh, ridge = self.single.mesh, self.settings.ridge

        def applied(c: torch.Tensor) -> torch.Tensor:
            product = mesh.transposed(_times(curvature, mesh.field(c)))
            return product + _stiff(c, self.single, ridge)

        ready = _preconditioner(curvature, self.single, ridge)
        return conjugate_gradients(applied, right, ready, tolerance, steps)


def solved(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    settings: VariationalSettings,
    iteration: int,
) -> Posterior:
    """One Gauss-Newton step; the number `iteration` seeds the flows drawn from the posterior."""
    ridge, solver = settings.ridge, settings.solver
    lumps = [
        linear_weights(m.to(p), p).T for m, p in zip(prior.mesh.places, mesh.places, strict=True)
    ]
    # knots have the precision of the prior, which may be strong; voxels have their own
    coefficients, voxels = coefficients.to(prior.local), linear.slope.dtype
    dims = mesh.dims
    # lumped to the nodes of the prior, for draws and the preconditioner alone
    curvature = coefficients.new_empty(dims, dims, *prior.mesh.shape)
    for a, b in combinations_with_replacement(range(dims), 2):
        squares = linear.weight * linear.slope[a] * linear.slope[b]
        curvature[a, b] = curvature[b, a] = separable(squares, lumps)
    # the step itself has every voxel
    steep = linear.weight * linear.slope

    def informed(c: torch.Tensor) -> torch.Tensor:
        along = (linear.slope * mesh.field(c.to(voxels))).sum(1, keepdim=True)
        return mesh.transposed(along * steep).to(c)

    def applied(c: torch.Tensor) -> torch.Tensor:
        return informed(c) + _stiff(c, prior, ridge)

    right = mesh.transposed(linear.gradient).to(curvature)[None]
    right = right - _stiff(coefficients[None], prior, ridge)
    ready = _preconditioner(curvature, prior, ridge)
    (change,) = conjugate_gradients(applied, right, ready, solver.tolerance, solver.steps)
    single = prior.to(linear.slope)
    solution = coefficients + change
    return Posterior(solution, curvature, prior, single, settings, iteration, informed)


def _times(matrix: torch.Tensor, flows: torch.Tensor) -> torch.Tensor:
    """Matrices (components, components, ...) times flows (n, components, ...)."""
    total = matrix[:, 0] * flows[:, None, 0]
    for b in range(1, len(matrix)):
        total.addcmul_(matrix[:, b], flows[:, None, b])
    return total


def _stiff(coefficients: torch.Tensor, prior: Prior, ridge: float) -> torch.Tensor:
    """The prior's second derivative times coefficients (n, components, knots)."""
    rates = prior.weights * prior.rates(coefficients)
    return prior.rates_transposed(rates) + ridge * coefficients


def _root(curvature: torch.Tensor) -> torch.Tensor:
    """A square root of positive semidefinite matrices (components, components, ...)."""
    matrix = curvature.movedim((0, 1), (-2, -1))
    unit = torch.eye(len(curvature), dtype=matrix.dtype, device=matrix.device)
    # about a node with slopes in one direction the matrix is singular
    floor = 1e-5 * matrix.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-20
    root = torch.linalg.cholesky(matrix + floor[..., None, None] * unit)
    return root.movedim((-2, -1), (0, 1)).contiguous()


def _preconditioner(
    curvature: torch.Tensor, prior: Prior, ridge: float
) -> Callable[[torch.Tensor], torch.Tensor]:
    """The inverse of each knot's diagonal block (components, components)."""
    mesh = prior.mesh
    dims = mesh.dims

    def diagonal(values: torch.Tensor, orders: Sequence[int] = (0,) * dims) -> torch.Tensor:
        # the diagonal of a form has the squares of the basis functions
        bases = [mesh.basis(axis, n).square().T for axis, n in enumerate(orders)]
        return separable(values, bases)

    block = diagonal(curvature)
    for weight, (_, motion) in zip(prior.weights, prior.motions, strict=True):
        for a, orders, scale in motion:
            block[a, a] += diagonal(weight, orders) * scale**2
    for a in range(dims):
        block[a, a] += ridge
    inverse = torch.linalg.inv(block.movedim((0, 1), (-2, -1)).double()).to(curvature)
    inverse = inverse.movedim((-2, -1), (0, 1)).contiguous()
    return lambda c: _times(inverse, c)


def conjugate_gradients(
    applied: Callable[[torch.Tensor], torch.Tensor],
    right: torch.Tensor,
    preconditioned: Callable[[torch.Tensor], torch.Tensor],
    tolerance: float,
    steps: int,
) -> torch.Tensor:
    """Solutions (n, ...) of a symmetric positive system for right-hand sides (n, ...)."""

    def inner(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).flatten(1).sum(1).reshape(-1, *[1] * (a.ndim - 1))

    solution = torch.zeros_like(right)
    residual = right
    ahead = preconditioned(residual)
    direction = ahead
    energy = inner(residual, ahead)
    goal = tolerance**2 * energy
    for _ in range(steps):
        forward = applied(direction)
        # a system that is solved already takes no more steps
        length = energy / inner(direction, forward).clamp(min=1e-30)
        solution = solution + length * direction
        residual = residual - length * forward
        ahead = preconditioned(residual)
        before, energy = energy, inner(residual, ahead)
        if bool((energy <= goal).all()):
            break
        direction = ahead + energy / before.clamp(min=1e-30) * direction
    return solution
