"""The prior of a flow: vorticity is concentrated, divergence small.

Vorticity and divergence are white noise. Their variances, for each kind and place, are those of
largest evidence (MacKay 1992, Neural Comput. 4, 415-447): the retrieved flow's energy then equals
the prior variance less the posterior variance.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, halves, interpolated
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import separable

# Least rate at which the estimated ratio is taken to fall as a strength grows.
_SLOWEST = 0.15
# Width over that of the strengths by which `Prior.evened` averages variances.
_EVENED = 0.5
# Least standard deviation of a rate in a cell between knots, px per px: images of a flow without
# vorticity would make the prior stronger for ever.
_LEAST = 1e-4

Motion = tuple[tuple[int, int, float], ...]
"""A rate of the flow as terms (component, axis of its derivative, sign)."""


def _rotation(a: int, b: int) -> Motion:
    return (a, b, 1.0), (b, a, -1.0)


KINDS: dict[int, tuple[tuple[Motion, ...], ...]] = {
    2: ((_rotation(0, 1),), (((0, 0, 1.0), (1, 1, 1.0)),)),
    3: (
        (_rotation(1, 2),),
        (_rotation(0, 1), _rotation(0, 2)),
        (tuple((a, a, 1.0) for a in range(3)),),
    ),
}
"""Kinds of motion by number of dimensions, divergence last.

In a volume vorticity along x and across x are two kinds: the vortices of a wake lie along x.
"""


class Divergence(NamedTuple):
    """Divergence in a plane: its variance has a uniform part.

    Attributes
    ----------
    strength : float
        Where there is no vorticity, as from wind across the plane.
    ratio : float
        Strength over the vorticity's of further divergence, as where splines do not resolve a core.
    trend : (torch.Tensor, torch.Tensor) of no dimension, optional
        ln of the strength one round before, and of the ratio estimated for it.
    """

    strength: float
    ratio: float
    trend: tuple[torch.Tensor, torch.Tensor] | None = None


class Prior(NamedTuple):
    """Each kind of motion is white noise of variance 1 / strength.

    Attributes
    ----------
    local : torch.Tensor, shape (kinds, *mesh.shape)
        Strength of the kinds whose strength varies from place to place.
    mesh : Mesh
        At half the spacing of the knots.
    width : float
        Over which the strength may vary, px.
    spacing : tuple of float
        Of the pixels along each axis, in any unit: rates are those in space.
    divergence : Divergence, optional
        Of a plane; in a volume divergence is a local kind.
    trend : (torch.Tensor, torch.Tensor), optional
        ln of the local strength one round before, and of the ratio estimated for it.
    """

    local: torch.Tensor
    mesh: Mesh
    width: float
    spacing: tuple[float, ...]
    divergence: Divergence | None = None
    trend: tuple[torch.Tensor, torch.Tensor] | None = None

    @property
    def cell(self) -> float:
        """Area or volume of a cell of the mesh, px^2 or voxels."""
        # the mesh has two steps between knots
        return math.prod((axis.size - 1) / (2 * axis.cells) for axis in self.mesh.axes)

    @property
    def strength(self) -> torch.Tensor:
        """Of every kind, (kinds, *mesh.shape)."""
        if self.divergence is None:
            return self.local
        return torch.cat([self.local, self._divergent(self.divergence)[None]])

    @property
    def motions(self) -> list[tuple[int, Motion]]:
        """Every motion with the number of its kind, its terms scaled to rates in space."""
        return [
            # displacements are in pixels of their own axis, distances in those of the other
            (kind, tuple((a, b, sign * self.spacing[a] / self.spacing[b]) for a, b, sign in motion))
            for kind, motions in enumerate(KINDS[self.mesh.dims])
            for motion in motions
        ]

    def rates(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Motions of flows (..., components, knots) on the mesh: (..., motions, *mesh.shape)."""
        slopes = self.mesh.slopes(coefficients)
        component = -1 - self.mesh.dims

        def rate(motion: Motion) -> torch.Tensor:
            terms = (scale * slopes[b].select(component, a) for a, b, scale in motion)
            return reduce(torch.add, terms)

        return torch.stack([rate(motion) for _, motion in self.motions], component)

    def rates_transposed(self, values: torch.Tensor) -> torch.Tensor:
        """The transpose of `rates`: (..., motions, *mesh.shape) to coefficients."""
        dims = self.mesh.dims
        component = -1 - dims
        shape = list(values.shape)
        shape[component] = dims
        parts = [values.new_zeros(shape) for _ in range(dims)]
        for (_, motion), value in zip(self.motions, values.unbind(component), strict=True):
            for a, b, scale in motion:
                parts[b].select(component, a).add_(value, alpha=scale)
        return self.mesh.slopes_transposed(parts)

    def by_kind(self, squares: torch.Tensor) -> torch.Tensor:
        """(..., motions, *mesh.shape) summed to (..., kinds, *mesh.shape)."""
        component = -1 - self.mesh.dims
        parts: list[torch.Tensor | float] = [0.0] * len(KINDS[self.mesh.dims])
        for (kind, _), square in zip(self.motions, squares.unbind(component), strict=True):
            parts[kind] = parts[kind] + square
        return torch.stack([torch.as_tensor(part) for part in parts], component)

    @property
    def weights(self) -> torch.Tensor:
        """Of the squares of what `rates` gives, (motions, *mesh.shape)."""
        strength = self.cell * self.strength
        return strength[[kind for kind, _ in self.motions]]

    def updated(
        self,
        informed: torch.Tensor,
        energy: torch.Tensor,
        settings: VariationalSettings,
        noise_known: bool = False,
    ) -> "Prior":
        """The prior after a step toward largest evidence (MacKay's fixed point).

        Parameters
        ----------
        informed, energy : torch.Tensor, shape (kinds, *mesh.shape)
            Variance of each kind of motion removed by the images, and its square in the flow.
        settings : VariationalSettings
        noise_known : bool
            Whether the noise is known, so that the largest evidence itself is wanted: steps are
            then those of the secant. Where the noise is that of the misfit, what the flow absorbs
            is missing in it, and the strength would grow too far.
        """
        count = len(self.local)
        most = settings.largest_change_trusted if noise_known else settings.largest_change
        # over the prior variance 1 / local, so that the mean is not that of the strongest motion
        removed, found = (self.smooth(self.local * part[:count]) for part in (informed, energy))
        # strengths vary over decades and stay positive: steps are those of their logarithm
        trend = self.local.log(), bounded(removed, found, most).log()
        change = _secant(trend, self.trend if noise_known else None, math.log(most)).exp()
        # white noise has the variance cells / strength in its mean over a cell between knots
        local = (self.local * change).clamp(max=_cells(self.mesh) / _LEAST**2)
        divergence = self.divergence
        if divergence is not None:
            divergence = self._updated(divergence, informed[-1], energy[-1], settings)
        return self._replace(local=local, divergence=divergence, trend=trend)

    def to(self, like: torch.Tensor) -> "Prior":
        """The same in the precision of a tensor."""
        mesh = Mesh(self.mesh.axes, [place.to(like) for place in self.mesh.places])
        return self._replace(local=self.local.to(like), mesh=mesh)

    def smooth(self, values: torch.Tensor) -> torch.Tensor:
        """Gaussian mean over the mesh, of standard deviation `width`."""
        kernels = []
        for place in self.mesh.places:
            kernel = torch.exp(-((place[:, None] - place) / self.width).square() / 2)
            # of sum 1 at the rim too, beyond which half of the Gaussian is missing
            kernels.append(kernel / kernel.sum(1, keepdim=True))
        return separable(values, kernels)

    def evened(self) -> "Prior":
        """With variances averaged over half the width within which they vary little.

        The strength of a place is estimated from few motions. A core in which images hardly show
        any swirl can take its vorticity for concentrated, and be smoothed the less for it.
        """
        wider = self._replace(width=_EVENED * self.width)
        return self._replace(local=1 / wider.smooth(1 / self.local))

    def _divergent(self, parts: Divergence) -> torch.Tensor:
        """Strength of all divergence in a plane: its variances add."""
        return 1 / (1 / parts.strength + 1 / (parts.ratio * self.local[0]))

    def _updated(
        self,
        before: Divergence,
        informed: torch.Tensor,
        energy: torch.Tensor,
        settings: VariationalSettings,
    ) -> Divergence:
        all_of_it = self._divergent(before)
        # of the variance of divergence, the part that is the same everywhere
        fraction = all_of_it / before.strength
        largest = settings.largest_change_divergence
        everywhere, in_cores = (
            float(
                bounded(
                    (part * all_of_it * informed).mean(), (part * all_of_it * energy).mean(), most
                )
            )
            for part, most in ((fraction, largest), (1 - fraction, settings.largest_change))
        )
        trend = torch.tensor(before.strength).log(), torch.tensor(everywhere).log()
        # images of weak texture without measurable divergence are no evidence that there is none
        most = settings.largest_ratio / float((1 / self.local[0]).mean())
        change = float(_secant(trend, before.trend, math.log(largest)).exp())
        return Divergence(min(before.strength * change, most), before.ratio * in_cores, trend)


def _secant(
    now: tuple[torch.Tensor, torch.Tensor],
    before: tuple[torch.Tensor, torch.Tensor] | None,
    limit: float,
) -> torch.Tensor:
    """Change of ln strength that brings ln of its ratio to 0, by the secant of two rounds.

    Where the images inform little, the fixed point alone would take hundreds of rounds.
    """
    # of slope -1 the step is the fixed point: the strength times its ratio
    slope = -torch.ones_like(now[1])
    if before is not None:
        run = now[0] - before[0]
        secant = (now[1] - before[1]) / torch.where(run == 0, 1.0, run)
        # no shorter than at the fixed point, and at most 1 / _SLOWEST times as long
        slope = torch.where(run == 0, slope, secant.clamp(-1.0, -_SLOWEST))
    return (-now[1] / slope).clamp(-limit, limit)


def _cells(mesh: Mesh) -> float:
    """Cells between knots per pixel, of a mesh at half the spacing of the knots."""
    return math.prod(axis.cells / axis.size for axis in mesh.axes)


def bounded(informed: torch.Tensor, energy: torch.Tensor, most: float) -> torch.Tensor:
    """Ratio of the two, at most this factor from 1: far from the fixed point it may be 0."""
    return (informed.clamp(min=0) / energy.clamp(min=1e-30)).clamp(1 / most, most)


def first_prior(
    axes: Sequence[Axis],
    coefficients: torch.Tensor,
    width: float,
    spacing: Sequence[float],
    settings: VariationalSettings,
) -> Prior:
    """A prior of the strength that matches a flow's vorticity: in a volume at each place."""
    mesh = halves(axes, coefficients)
    dims = mesh.dims
    one = torch.ones(len(KINDS[dims]), *mesh.shape).to(coefficients)
    prior = Prior(one, mesh, width, tuple(spacing))
    vorticity = prior.by_kind(prior.rates(coefficients).square())[:-1].sum(0)
    vorticity = vorticity.mean() if dims == 2 else prior.smooth(vorticity)
    strength = (dims - 1) * _cells(mesh) / (vorticity + settings.least_vorticity**2)
    if dims == 2:
        divergence = Divergence(settings.ratio * float(strength), settings.ratio)
        return prior._replace(local=strength * one[:1], divergence=divergence)
    local = strength * one
    local[-1] *= settings.ratio
    return prior._replace(local=local)


def refined(prior: Prior, axes: Sequence[Axis]) -> Prior:
    """A prior estimated on coarser knots, interpolated to finer ones."""
    mesh = halves(axes, prior.local)
    # from core to still air the strength changes by decades: its logarithm is smoother
    local = interpolated(prior.local.log(), prior.mesh.places, mesh.places).exp()
    # a secant through rounds on different knots would be none
    trendless = prior.divergence and prior.divergence._replace(trend=None)
    return prior._replace(local=local, mesh=mesh, divergence=trendless, trend=None)
