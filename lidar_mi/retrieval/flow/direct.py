"""The flow in a plane, solved directly: exact posterior covariance and evidence."""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow import band_cholesky, cyclic_reduction
from lidar_mi.retrieval.flow.band import Band, along_y, along_z, form, spread
from lidar_mi.retrieval.flow.band_cholesky import BandCholesky, cholesky, solved_near
from lidar_mi.retrieval.flow.flow_spline import REACH, Mesh
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.posterior import Root
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import working

# Relative rounding error of a factorisation: fifty times that of one entry.
_ROUNDING = 1e-14

# Residual over the right hand side that a step with a factor in single precision may leave.
_SINGLE = 1e-3
# Of a covariance in single precision, how much a diagonal element of its product with the form may
# differ from 1: degrees of freedom of a coefficient.
_INVERSE = 1e-3
# Products with a form until conjugate gradients from a similar one are given up.
_MOST_PRODUCTS = 12


class Posterior(NamedTuple):
    """A flow after a Gauss-Newton step, and the factor of the posterior's precision there.

    coefficients (2, Z, Y)
    whole, stiff (2, 2, 7, Z, 4, Y): that precision, and the prior's part of it: bands.
    root, before: of both.
    """

    coefficients: torch.Tensor
    whole: torch.Tensor
    stiff: torch.Tensor
    root: Root
    before: Root
    prior: Prior

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: prior less posterior variance, and its square in the flow."""
        after = covariance_near(self.root, self.whole)
        energy = self.prior.by_kind(self.prior.rates(self.coefficients).square())
        return variances(self.before.covariance() - after, self.prior), energy

    def response(self, gradients: torch.Tensor) -> torch.Tensor:
        """Changes of the coefficients by gradients (..., components, knots)."""
        return self.root.solve(gradients)

    def prior_gradient(self, flows: torch.Tensor) -> torch.Tensor:
        """The prior's precision times coefficients (n, 2, Z, Y)."""
        return _band(self.prior.mesh).apply(self.stiff, flows)

    def fitted(self, gradients: torch.Tensor, strength: float = 1.0) -> torch.Tensor:
        """Coefficients by gradients (n, 2, Z, Y), with the prior's precision times a strength."""
        if strength == 1:
            return self.root.solve(gradients)
        (root,) = factored((self.whole + (strength - 1) * self.stiff)[None])
        return root.solve(gradients)

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before."""
        mesh = Mesh(self.prior.mesh.axes, places)
        after, before = (spread(root.covariance(), mesh) for root in (self.root, self.before))
        return after, before


def factored(forms: torch.Tensor) -> Sequence[Root]:
    """Factors of forms (n, 2, 2, 7, Z, 4, Y) in double precision.

    By LAPACK, or at once on any other device.

    Raises
    ------
    torch.linalg.LinAlgError
        One is not positive definite.
    """
    if by_lapack(forms):
        return band_cholesky.factored(forms)
    return cyclic_reduction.factored(working(forms))


def by_lapack(form: torch.Tensor) -> bool:
    """Whether a form is factored on the processor: where it is."""
    return form.device.type == "cpu"


def covariance_near(root: Root, form: torch.Tensor) -> torch.Tensor:
    """That of a form's factor to `_INVERSE`, where it is, in single precision."""
    if isinstance(root, BandCholesky):
        covariance = root.single.covariance().to(form)
        band = Band(form.shape[3], form.shape[5])
        # the product of both matrices has ones on its diagonal
        ones = band.apply(covariance * form, form.new_ones(2, form.shape[3], form.shape[5]))
        if bool(((ones - 1).abs() < _INVERSE).all()):
            return covariance
    return root.covariance()


def solved(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    settings: VariationalSettings,
    iteration: int,
) -> Posterior:
    """One Gauss-Newton step; `iteration` is for `iterative` only."""
    stiff, gradient = prior_and_gradient(linear, mesh, coefficients, prior, settings.ridge)
    whole = data_form(linear, mesh) + stiff
    root, before = factored(torch.stack([whole, stiff]))
    return Posterior(coefficients + root.solve(gradient), whole, stiff, root, before, prior)


class PriorTerm(NamedTuple):
    """The prior of a flow: its quadratic form with the ridge, and its gradient there.

    `whole` also has what keeps the form positive in spite of rounding.
    """

    stiff: torch.Tensor
    whole: torch.Tensor
    gradient: torch.Tensor

    def at(self, prior: Prior, coefficients: torch.Tensor) -> "PriorTerm":
        """The same of another flow."""
        return self._replace(gradient=-_band(prior.mesh).apply(self.stiff, coefficients))


def prior_term_of(prior: Prior, coefficients: torch.Tensor, ridge: float) -> PriorTerm:
    """That of a prior at a flow."""
    stiff = prior_form(prior)
    with_diagonal(stiff, ridge)
    # the gradient is without what is against rounding: the minimum stays where it is
    whole = stiff.clone()
    with_diagonal(whole, rounding(stiff))
    return PriorTerm(stiff, whole, stiff).at(prior, coefficients)


def solved_in_single(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior_term: PriorTerm,
    near: Root | None = None,
) -> torch.Tensor:
    """Coefficients after a step in single precision; its residual is looked at in double precision.

    By conjugate gradients from the factor of a form that is `near` the step's own, or by the factor
    of that. Where there is no such factor, or the residual is not small, all is in double
    precision; so it is on another device than the processor.
    """
    gradient = mesh.transposed(linear.gradient) + prior_term.gradient
    whole = data_form(linear, mesh) + prior_term.whole
    if not by_lapack(whole):
        return coefficients + factored(whole[None])[0].solve(gradient)
    if isinstance(near, BandCholesky):
        step = solved_near(near, whole, gradient, _SINGLE, _MOST_PRODUCTS)
        if step is not None:
            return coefficients + step
    root = cholesky(whole.float())
    if root is not None:
        step = root.solve(gradient)
        residual = gradient - _band(mesh).apply(whole, step)
        if bool(residual.norm() <= _SINGLE * gradient.norm()):
            return coefficients + step
    return coefficients + factored(whole[None])[0].solve(gradient)


def factor_in_single(form: torch.Tensor) -> Root:
    """Factor of a form in single precision; in double where there is none, and on other devices."""
    single = cholesky(form.float()) if by_lapack(form) else None
    return single or factored(form[None])[0]


def _band(mesh: Mesh) -> Band:
    return Band(*(axis.knots for axis in mesh.axes))


def prior_and_gradient(
    linear: Linear, mesh: Mesh, coefficients: torch.Tensor, prior: Prior, ridge: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The prior's quadratic form with its ridge, and the gradient of the log-posterior."""
    stiff = prior_form(prior)
    with_diagonal(stiff, ridge)
    band = _band(mesh)
    gradient = mesh.transposed(linear.gradient) - band.apply(stiff, coefficients)
    # after the gradient: the steps are shorter, and end at the same flow
    with_diagonal(stiff, rounding(stiff))
    return stiff, gradient


def data_form(linear: Linear, mesh: Mesh, cells: slice | None = None) -> torch.Tensor:
    """Quadratic form of the images' information, of all cells along z or some (`band.form`)."""
    return form_of_slopes(linear.weight, linear.slope, mesh, cells)


def form_of_slopes(
    weight: torch.Tensor, slope: torch.Tensor, mesh: Mesh, cells: slice | None = None
) -> torch.Tensor:
    """That of sum(weight * (slope . flow)^2), slopes (2, z, y): both mixed parts are alike."""
    z, y = slope
    first, mixed, last = form(weight * torch.stack([z * z, z * y, y * y]), mesh, cells=cells)
    return torch.stack([first, mixed, mixed, last]).unflatten(0, (2, 2))


def prior_form(prior: Prior, cells: slice | None = None) -> torch.Tensor:
    """The prior's quadratic form without its ridge, of all cells along z or of some."""
    mesh = prior.mesh
    rows = mesh.axes[0].knots if cells is None else cells.stop - cells.start + REACH
    total = prior.local.new_zeros(2, 2, 2 * REACH + 1, rows, REACH + 1, mesh.axes[1].knots)
    # kinds of motion share products of derivatives: each product is summed once
    pairs: dict[tuple[tuple[int, ...], ...], list[tuple[int, int, int, float]]] = {}
    for kind, terms in prior.motions:
        for a, first, one in terms:
            for b, second, other in terms:
                pairs.setdefault((first, second), []).append((kind, a, b, one * other))
    # the integral over the plane is a sum over the cells of the mesh
    weight = prior.cell * prior.local
    for (first, second), members in pairs.items():
        kinds = sorted({kind for kind, *_ in members})
        parts = form(weight[kinds], mesh, first, second, cells)
        for kind, a, b, scale in members:
            total[a, b].add_(parts[kinds.index(kind)], alpha=scale)
    return total


def variances(covariance: torch.Tensor, prior: Prior, cells: slice | None = None) -> torch.Tensor:
    """Variance of each kind of motion (kinds, ...) on the prior's mesh, from a band's."""
    mesh = prior.mesh
    # shifts back along y are those ahead with the derivatives exchanged, which is another summand
    covariance = covariance.clone()
    covariance[..., 1:, :] *= 2
    # motions share derivatives: each is taken once
    middles: dict[tuple[int, ...], torch.Tensor] = {}
    forms: dict[tuple[int, int, tuple[int, ...], tuple[int, ...]], torch.Tensor] = {}

    def of(a: int, b: int, first: tuple[int, ...], second: tuple[int, ...]) -> torch.Tensor:
        key = a, b, first[0], second[0]
        if key not in middles:
            middles[key] = along_z(covariance[a, b], mesh, first[0], second[0], cells)
        if (a, b, first, second) not in forms:
            forms[a, b, first, second] = along_y(middles[key], mesh, first[1], second[1])
        return forms[a, b, first, second]

    return prior.by_kind(
        torch.stack(
            [
                reduce(
                    torch.add,
                    (
                        one * other * of(a, b, first, second)
                        for a, first, one in terms
                        for b, second, other in terms
                    ),
                )
                for _, terms in prior.motions
            ]
        )
    )


def with_diagonal(form: torch.Tensor, value: float | torch.Tensor) -> None:
    """Add a number to the diagonal, as the ridge that keeps the variance of rigid motion finite."""
    for a in (0, 1):
        form[a, a, REACH, :, 0] += value


def rounding(form: torch.Tensor) -> torch.Tensor:
    """What keeps a quadratic form positive in spite of rounding; this only shortens the steps.

    Noise-free images of a flow without any vorticity make the prior stronger than the ridge by
    more than the floating-point precision.
    """
    return _ROUNDING * form.amax()
