"""The flow in a large plane, solved in overlapping strips: work in proportion to the pixels.

Images inform the flow within a few knots. What a strip of the image says about its middle then
hardly depends on what lies beyond the strip. Strips extend along y over the whole image.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.band import Band, spread
from lidar_mi.retrieval.flow.direct import (
    covariance_near,
    data_form,
    factored,
    prior_and_gradient,
    prior_form,
    rounding,
    variances,
    with_diagonal,
)
from lidar_mi.retrieval.flow.flow_spline import REACH, Axis, Mesh, halves
from lidar_mi.retrieval.flow.iterative import conjugate_gradients
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import separable
from lidar_mi.retrieval.threads import mapped


class Strip(NamedTuple):
    """Cells along z that are solved at once, and those of them whose result counts."""

    cells: slice
    core: slice

    @property
    def knots(self) -> slice:
        """Those that reach into the strip's cells."""
        return slice(self.cells.start, self.cells.stop + REACH)

    def of_core(self, covariance: torch.Tensor) -> torch.Tensor:
        """The covariance (..., knot z, shift y, knot y) of the knots that reach into the core."""
        first = self.cells.start
        return covariance[..., self.core.start - first : self.core.stop - first + REACH, :, :]


class Posterior(NamedTuple):
    """A flow after a Gauss-Newton step, with the posterior's precision there.

    `stiff` is the prior's part of it, `whole` all of it: bands. `images` is the
    likelihood that they are of, and its mesh.
    """

    coefficients: torch.Tensor
    stiff: torch.Tensor
    whole: torch.Tensor
    prior: Prior
    images: tuple[Linear, Mesh]
    settings: VariationalSettings
    inverse: "Inverse"

    def response(self, gradients: torch.Tensor) -> torch.Tensor:
        """Changes of the coefficients by gradients (n, components, knots), to a loose tolerance."""
        return self.inverse(gradients, self.settings.strips.loose)

    def prior_gradient(self, flows: torch.Tensor) -> torch.Tensor:
        """The prior's precision times coefficients (n, 2, Z, Y)."""
        return _band(self.prior).apply(self.stiff, flows)

    def fitted(self, gradients: torch.Tensor, strength: float = 1.0) -> torch.Tensor:
        """Coefficients by gradients (n, 2, Z, Y), with the prior's precision times a strength."""
        inverse = self.inverse
        if strength != 1:
            inverse = _inverse(self.whole + (strength - 1) * self.stiff, self.prior, self.settings)
        return inverse(gradients, self.settings.strips.tolerance)

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: the variance removed by the images, and its square in the flow.

        The variance removed is that in each strip alone.
        """
        prior, solver = self.prior, self.settings.strips

        def informed(strip: Strip) -> torch.Tensor:
            forms = self._alone(strip)
            before, root = factored(forms)
            removed = before.covariance() - covariance_near(root, forms[1])
            return variances(strip.of_core(removed), prior, strip.core)

        energy = prior.by_kind(prior.rates(self.coefficients).square())
        # with half of this overlap the variances are 2 to 3 % too large in the middle of a strip
        cut = strips(prior.mesh.axes[0].cells, solver.core, solver.overlap)
        return torch.cat(mapped(informed, cut), 1), energy

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before.

        After the images it is that of strips alone: too large by what lies beyond them, see
        `StripSettings.final_overlap`. Before them it is that of coarser splines.
        """
        prior, solver = self.prior, self.settings.strips
        mesh = Mesh(prior.mesh.axes, places)

        def after(strip: Strip) -> torch.Tensor:
            covariance = factored(self._alone(strip)[1:])[0].covariance()
            return spread(strip.of_core(covariance), mesh, cells=strip.core)

        # information beyond a strip is missing in it: errors come out too large
        cut = strips(mesh.axes[0].cells, solver.final_core, solver.final_overlap)
        return torch.cat(mapped(after, cut), 2), _before(mesh, prior, self.settings)

    def _alone(self, strip: Strip) -> torch.Tensor:
        """The bands (2, ...) of prior and posterior as if image and prior ended with a strip."""
        cells, last = strip.cells, self.prior.mesh.axes[0].cells
        bands = torch.stack([band[:, :, :, strip.knots] for band in (self.stiff, self.whole)])
        # splines at the strip's ends reach into three cells beyond
        if cells.start:
            beyond = self._of(slice(max(0, cells.start - REACH), cells.start))
            # forms are sums over cells: those outside the strip are subtracted
            bands[..., :REACH, :, :] -= beyond[..., -REACH:, :, :]
        if cells.stop < last:
            beyond = self._of(slice(cells.stop, min(cells.stop + REACH, last)))
            bands[..., -REACH:, :, :] -= beyond[..., :REACH, :, :]
        return bands

    def _of(self, cells: slice) -> torch.Tensor:
        """The bands (2, ...) of prior and posterior of some cells."""
        form = prior_form(self.prior, cells)
        return torch.stack([form, form + data_form(*self.images, cells)])


def strips(cells: int, core: int, overlap: int) -> list[Strip]:
    """Strips of one width with cores of about so many cells, and this overlap or more."""
    number = max(1, round((cells - 2 * overlap) / core))
    # of one width, so that several are factored as one batch
    width = min(cells, -(-(cells - 2 * overlap) // number) + 2 * overlap)
    starts = [round(i * (cells - width) / max(1, number - 1)) for i in range(number)]
    # cores meet without a gap; the first and the last reach the edges of the image
    edges = [0, *(start + overlap for start in starts[1:]), cells]
    return [
        Strip(slice(start, start + width), slice(*edges[i : i + 2]))
        for i, start in enumerate(starts)
    ]


def solved(
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    settings: VariationalSettings,
    iteration: int,
) -> Posterior:
    """One Gauss-Newton step; `iteration` is for `iterative` only.

    By conjugate gradients. The preconditioner is the sum of the strips' inverses, each with the
    flow beyond it held (additive Schwarz method; Toselli & Widlund 2005, Domain Decomposition
    Methods, chapter 2).
    """
    stiff, gradient = prior_and_gradient(linear, mesh, coefficients, prior, settings.ridge)
    whole = data_form(linear, mesh) + stiff
    inverse = _inverse(whole, prior, settings)
    # a loose solution suffices: the next round takes another step
    (change,) = inverse(gradient[None], settings.strips.tolerance)
    return Posterior(coefficients + change, stiff, whole, prior, (linear, mesh), settings, inverse)


Inverse = Callable[[torch.Tensor, float], torch.Tensor]
"""Solutions of a system for right hand sides (n, 2, Z, Y), to a tolerance."""


def _band(prior: Prior) -> Band:
    return Band(*(axis.knots for axis in prior.mesh.axes))


def _inverse(whole: torch.Tensor, prior: Prior, settings: VariationalSettings) -> Inverse:
    solver, band = settings.strips, _band(prior)
    cut = strips(prior.mesh.axes[0].cells, solver.solved_core, solver.solved_overlap)
    roots = factored(torch.stack([whole[:, :, :, strip.knots] for strip in cut]))
    parts = list(zip(cut, roots, strict=True))

    def preconditioned(right: torch.Tensor) -> torch.Tensor:
        total = torch.zeros_like(right)
        solved = mapped(lambda part: part[1].solve(right[..., part[0].knots, :]), parts)
        for strip, solution in zip(cut, solved, strict=True):
            total[..., strip.knots, :] += solution
        return total

    def solved_to(right: torch.Tensor, tolerance: float) -> torch.Tensor:
        # a strong prior needs double precision, whatever the gradients are in
        return conjugate_gradients(
            lambda c: band.apply(whole, c), right.to(whole), preconditioned, tolerance, solver.steps
        ).to(right)

    return solved_to


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
    # variances are averaged, not strengths: they are what adds up over an area
    local = 1 / separable(1 / prior.local, means)
    form = prior_form(prior._replace(local=local, mesh=coarse))
    rows, columns = (axis.knots for axis in axes)
    fine_rows, fine_columns = (axis.knots for axis in mesh.axes)
    # uniform flow has the same ridge in spite of fewer coefficients
    with_diagonal(form, settings.ridge * fine_rows * fine_columns / (rows * columns))
    with_diagonal(form, rounding(form))
    return spread(factored(form[None])[0].covariance(), Mesh(axes, mesh.places))
