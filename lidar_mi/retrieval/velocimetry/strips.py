"""The flow in a large plane, solved in overlapping strips: work in proportion to the pixels.

Images inform the flow within a few knots. What a strip of the image says about its middle then
hardly depends on what lies beyond the strip. Strips extend along y over the whole image.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.threads import mapped
from lidar_mi.retrieval.velocimetry.band import Band, spread
from lidar_mi.retrieval.velocimetry.block_banded import Factor
from lidar_mi.retrieval.velocimetry.direct import (
    data_form,
    prior_and_gradient,
    prior_form,
    rounding,
    variances,
    with_diagonal,
)
from lidar_mi.retrieval.velocimetry.flow_spline import REACH, Axis, Mesh, halves
from lidar_mi.retrieval.velocimetry.iterative import conjugate_gradients
from lidar_mi.retrieval.velocimetry.likelihood import Linear
from lidar_mi.retrieval.velocimetry.prior import Prior
from lidar_mi.retrieval.velocimetry.settings import VariationalSettings
from lidar_mi.retrieval.velocimetry.windows import separable


class Strip(NamedTuple):
    """Cells along z that are solved at once, and those of them whose result counts."""

    cells: slice
    core: slice

    @property
    def knots(self) -> slice:
        """Those that reach into the strip's cells."""
        return slice(self.cells.start, self.cells.stop + REACH)


class Matrix(NamedTuple):
    """A second derivative as a band, with what it is made of.

    Attributes
    ----------
    band : torch.Tensor
    prior : Prior
    images : (Linear, Mesh), optional
        None for the prior alone.
    """

    band: torch.Tensor
    prior: Prior
    images: tuple[Linear, Mesh] | None

    def alone(self, strip: Strip) -> torch.Tensor:
        """The band of a strip as if image and prior ended with it."""
        cells, last = strip.cells, self.prior.mesh.axes[0].cells
        own = self.band[:, :, :, strip.knots].clone()
        # splines at the strip's ends reach into three cells beyond
        if cells.start:
            beyond = self._of(slice(max(0, cells.start - REACH), cells.start))
            own[:, :, :, :REACH] -= beyond[:, :, :, -REACH:]
        if cells.stop < last:
            beyond = self._of(slice(cells.stop, min(cells.stop + REACH, last)))
            own[:, :, :, -REACH:] -= beyond[:, :, :, :REACH]
        return own

    def _of(self, cells: slice) -> torch.Tensor:
        form = prior_form(self.prior, cells)
        return form + data_form(*self.images, cells) if self.images else form


class Posterior(NamedTuple):
    """A flow after a Gauss-Newton step, with the second derivative there."""

    coefficients: torch.Tensor
    stiff: Matrix
    both: Matrix
    settings: VariationalSettings

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: the variance removed by the images, and its square in the flow.

        The variance removed is that in each strip alone.
        """
        prior, solver = self.stiff.prior, self.settings.strips

        def informed(strip: Strip) -> torch.Tensor:
            before, after = (_covariance(strip, m.alone(strip)) for m in (self.stiff, self.both))
            return variances(before - after, prior, strip.core)

        energy = prior.by_kind(prior.rates(self.coefficients).square())
        cut = strips(prior.mesh.axes[0].cells, solver.core, solver.overlap)
        return torch.cat(mapped(informed, cut), 1), energy

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before.

        After the images it is that of strips alone: too large by what lies beyond them, see
        `StripSettings.final_overlap`. Before them it is that of coarser splines.
        """
        prior, solver = self.stiff.prior, self.settings.strips
        mesh = Mesh(prior.mesh.axes, places)

        def after(strip: Strip) -> torch.Tensor:
            covariance = _covariance(strip, self.both.alone(strip))
            return spread(covariance, mesh, cells=strip.core)

        cut = strips(mesh.axes[0].cells, solver.core, solver.final_overlap)
        return torch.cat(mapped(after, cut), 2), _before(mesh, prior, self.settings)


def strips(cells: int, core: int, overlap: int) -> list[Strip]:
    """Strips of one width with cores of about so many cells, and this overlap or more."""
    number = max(1, round((cells - 2 * overlap) / core))
    width = min(cells, -(-(cells - 2 * overlap) // number) + 2 * overlap)
    starts = [round(i * (cells - width) / max(1, number - 1)) for i in range(number)]
    edges = [0, *(start + overlap for start in starts[1:]), cells]
    return [
        Strip(slice(start, start + width), slice(*edges[i : i + 2]))
        for i, start in enumerate(starts)
    ]


def _covariance(strip: Strip, form: torch.Tensor) -> torch.Tensor:
    """The inverse of a strip's matrix within the band, of the knots that reach into its core."""
    band = Band(form.shape[3], form.shape[5])
    first = strip.cells.start
    core = slice(strip.core.start - first, strip.core.stop - first + REACH)
    return band.covariance(band.factor(form))[:, :, :, core]


def solved(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    settings: VariationalSettings,
    turn: int,
) -> Posterior:
    """One Gauss-Newton step; `turn` is for `iterative` only.

    By conjugate gradients. The preconditioner is the sum of the strips' inverses, each with the
    flow beyond it held (additive Schwarz method; Toselli & Widlund 2005, Domain Decomposition
    Methods, chapter 2).
    """
    solver = settings.strips
    whole = Band(*(axis.knots for axis in mesh.axes))
    stiff, gradient = prior_and_gradient(linear, mesh, coefficients, prior, settings.ridge)
    both = Matrix(data_form(linear, mesh) + stiff, prior, (linear, mesh))
    cut = strips(mesh.axes[0].cells, solver.solved_core, solver.solved_overlap)
    # those that one thread solves at once
    some = [cut[i : i + solver.at_once] for i in range(0, len(cut), solver.at_once)]
    band = Band(cut[0].cells.stop - cut[0].cells.start + REACH, whole.columns)
    roots = mapped(
        lambda part: band.factor(torch.stack([both.band[:, :, :, s.knots] for s in part])), some
    )

    def inverse(part: tuple[list[Strip], Factor], right: torch.Tensor) -> torch.Tensor:
        members, root = part
        return band.solve(root, torch.stack([right[:, s.knots] for s in members]))

    def preconditioned(right: torch.Tensor) -> torch.Tensor:
        total = torch.zeros_like(right)
        found = mapped(lambda part: inverse(part, right[0]), list(zip(some, roots, strict=True)))
        for strip, part in zip(cut, torch.cat(found), strict=True):
            total[0, :, strip.knots] += part
        return total

    (change,) = conjugate_gradients(
        lambda c: whole.apply(both.band, c[0])[None],
        gradient[None],
        preconditioned,
        solver.tolerance,
        solver.steps,
    )
    return Posterior(coefficients + change, Matrix(stiff, prior, None), both, settings)


def _before(mesh: Mesh, prior: Prior, settings: VariationalSettings) -> torch.Tensor:
    """Covariance of the flow a priori, from splines on at most so many cells along each axis.

    Its scales are those of the image.
    """
    most = settings.strips.coarse_cells
    axes = [Axis(axis.size, max(axis.spacing, (axis.size - 1) / most)) for axis in mesh.axes]
    coarse = halves(axes, prior.local)
    means = []
    for axis, fine, own in zip(axes, prior.mesh.places, coarse.places, strict=True):
        number = (fine / (axis.size - 1) * 2 * axis.cells).floor().long()
        member = (number == torch.arange(len(own), device=fine.device)[:, None]).to(fine)
        means.append(member / member.sum(1, keepdim=True))
    local = 1 / separable(1 / prior.local, means)
    form = prior_form(prior._replace(local=local, mesh=coarse))
    knots, fine = ([axis.knots for axis in m] for m in (axes, mesh.axes))
    with_diagonal(form, settings.ridge * fine[0] * fine[1] / (knots[0] * knots[1]))
    with_diagonal(form, rounding(form))
    band = Band(*knots)
    return spread(band.covariance(band.factor(form)), Mesh(axes, mesh.places))
