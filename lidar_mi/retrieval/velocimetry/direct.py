"""The flow in a plane, solved directly: exact posterior covariance and evidence."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.velocimetry.band import Band
from lidar_mi.retrieval.velocimetry.block_tridiagonal import Factor
from lidar_mi.retrieval.velocimetry.flow_spline import Mesh
from lidar_mi.retrieval.velocimetry.likelihood import Linear
from lidar_mi.retrieval.velocimetry.prior import Prior
from lidar_mi.retrieval.velocimetry.settings import VariationalSettings

# Relative rounding error of a factorisation: fifty times that of one entry.
_ROUNDING = 1e-14


class Posterior(NamedTuple):
    """A flow after a Gauss-Newton step, and the factor of the second derivative there.

    `stiff` is the prior's part of the second derivative, a band.
    """

    coefficients: torch.Tensor
    band: Band
    root: Factor
    prior: Prior
    stiff: torch.Tensor

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: the variance removed by the images, and its square in the flow."""
        before = self.band.covariance(self.band.factor(self.stiff))
        removed = before - self.band.covariance(self.root)
        informed = [
            sum(
                one * other * self.band.spread(removed[a, b], self.prior.mesh, first, second)
                for a, first, one in terms
                for b, second, other in terms
            )
            for terms in _kinds(self.prior)
        ]
        energy = self.prior.by_kind(self.prior.rates(self.coefficients).square())
        return torch.stack(informed), energy

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before."""
        mesh = Mesh(self.prior.mesh.axes, places)
        after, before = (
            self.band.spread(self.band.covariance(root), mesh)
            for root in (self.root, self.band.factor(self.stiff))
        )
        return after, before


def solved(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    settings: VariationalSettings,
    turn: int,
) -> Posterior:
    """One Gauss-Newton step; `turn` is for `iterative` only."""
    band = Band(*mesh.axes)
    data = band.form(linear.weight * linear.slope[:, None] * linear.slope, mesh)
    stiff = _prior_form(band, prior, settings.ridge)
    gradient = mesh.transposed(linear.gradient) - band.apply(stiff, coefficients)
    stiff = _damped(stiff)
    root = band.factor(data + stiff)
    return Posterior(coefficients + band.solve(root, gradient), band, root, prior, stiff)


def _prior_form(band: Band, prior: Prior, ridge: float) -> torch.Tensor:
    """The prior's quadratic form; the ridge keeps the variance of rigid motion finite."""
    form = prior.local.new_zeros(2, 2, 7, band.z.knots, 4, band.y.knots)
    for terms, strength in zip(_kinds(prior), prior.strength, strict=True):
        for a, first, one in terms:
            for b, second, other in terms:
                part = band.form(prior.cell * strength, prior.mesh, first, second)
                form[a, b] += one * other * part
    for a in (0, 1):
        form[a, a, 3, :, 0] += ridge
    return form


def _damped(stiff: torch.Tensor) -> torch.Tensor:
    """A quadratic form that stays positive in spite of rounding; this only shortens the steps.

    Noise-free images of a flow without any vorticity make the prior stronger than the ridge by
    more than the floating-point precision.
    """
    stiff = stiff.clone()
    least = _ROUNDING * float(stiff.amax())
    for a in (0, 1):
        stiff[a, a, 3, :, 0] += least
    return stiff


def _kinds(prior: Prior) -> list[list[tuple[int, tuple[int, int], float]]]:
    """Each kind's terms as (component, orders of its derivative along z and y, factor)."""
    return [
        [(a, (int(b == 0), int(b == 1)), scale) for a, b, scale in motion]
        for _, motion in prior.motions
    ]
