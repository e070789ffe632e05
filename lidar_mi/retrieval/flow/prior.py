"""The prior of a flow: vorticity and divergence of a spectrum and strength that images tell.

With the vorticity w and the divergence d the energy of a flow is the sum over four kinds of motion

    s(x) (L w^2 + M |grad w|^2 + D d^2 + N |grad d|^2),

so that vorticity has the spectral density 1 / (s (L + M k^2)). Small M is the spectrum of
turbulence, nearly white vorticity; large M that of smooth flows. The strength s varies over the
image: precisions that have a gamma distribution make vorticity heavy-tailed, concentrated in cores.
All follow from the largest evidence (MacKay 1992, Neural Comput. 4, 415-447): the energy of each
kind in the retrieved flow equals the prior variance less the posterior variance.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, halves, interpolated
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import separable

# Of the gamma distribution of the strengths: from Student's vorticity of one degree of freedom to
# nearly uniform strength.
_SHAPES = 0.5 * 2.0 ** torch.arange(7)
# Rounds of the fixed point for the mean of that distribution.
_ROUNDS = 20
# Limits of the strengths, of displacements in px.
_WEAKEST, _STRONGEST = 1e-6, 1e10
# Least standard deviation of a rate in a cell between knots of a volume, px per px.
_LEAST = 1e-4

Motion = tuple[tuple[int, tuple[int, ...], float], ...]
"""A rate of the flow as terms (component, orders of its derivative along the axes, sign)."""


def _along(dims: int, axis: int) -> tuple[int, ...]:
    return tuple(int(a == axis) for a in range(dims))


def _rotation(dims: int, a: int, b: int) -> Motion:
    return (a, _along(dims, b), 1.0), (b, _along(dims, a), -1.0)


def _divergence(dims: int) -> Motion:
    return tuple((a, _along(dims, a), 1.0) for a in range(dims))


def _gradient(motion: Motion) -> tuple[Motion, ...]:
    """Derivatives of a motion along all axes."""
    dims = len(motion[0][1])
    return tuple(
        tuple(
            (a, tuple(n + int(axis == c) for axis, n in enumerate(orders)), sign)
            for a, orders, sign in motion
        )
        for c in range(dims)
    )


KINDS: dict[int, tuple[tuple[Motion, ...], ...]] = {
    2: (
        (_rotation(2, 0, 1),),
        (_divergence(2),),
        _gradient(_rotation(2, 0, 1)),
        _gradient(_divergence(2)),
    ),
    3: ((_rotation(3, 1, 2),), (_rotation(3, 0, 1), _rotation(3, 0, 2)), (_divergence(3),)),
}
"""Kinds of motion by number of dimensions.

In a volume vorticity along x and across x are two kinds: the vortices of a wake lie along x.
"""


DIVERGENT: dict[int, tuple[tuple[int, int], ...]] = {2: ((1, 0), (3, 2)), 3: ()}
"""Kinds of divergence in a plane, each with the kind of vorticity of the same order."""


class Prior(NamedTuple):
    """Each kind of motion is white noise of variance 1 / strength.

    local (kinds, *mesh.shape): strength of each kind; the same from place to place but for a
        factor.
    mesh: at half the spacing of the knots.
    width: over which the strength may vary, px.
    spacing: of the pixels along each axis, in any unit: rates are those in space.
    """

    local: torch.Tensor
    mesh: Mesh
    width: float
    spacing: tuple[float, ...]

    @property
    def cell(self) -> float:
        """Area or volume of a cell of the mesh, px^2 or voxels."""
        # the mesh has two steps between knots
        return math.prod((axis.size - 1) / (2 * axis.cells) for axis in self.mesh.axes)

    @property
    def motions(self) -> list[tuple[int, Motion]]:
        """Every motion with the number of its kind, its terms scaled to rates in space."""
        return [
            # displacements are in pixels of their own axis, distances in those of the other
            (
                kind,
                tuple(
                    (a, orders, sign * self.spacing[a] / self._unit(orders))
                    for a, orders, sign in motion
                ),
            )
            for kind, motions in enumerate(KINDS[self.mesh.dims])
            for motion in motions
        ]

    def _unit(self, orders: tuple[int, ...]) -> float:
        return math.prod(s**n for s, n in zip(self.spacing, orders, strict=True))

    def density(self, wavenumber: torch.Tensor | float) -> torch.Tensor:
        """Spectral density of a component of the displacement, (*mesh.shape).

        Per (rad per px)^dims, at a wavenumber in rad per px. A motion of variance 1 has a
        displacement of 1 / k^2, which is shared by the components.
        """
        dims = self.mesh.dims
        if dims == 2:
            kinds = [self.local[k] + self.local[k + 2] * wavenumber**2 for k in (0, 1)]
        else:
            kinds = [self.local[kind] for kind, _ in self.motions]
        total = reduce(torch.add, [1 / kind for kind in kinds])
        return total / (dims * wavenumber**2)

    def rates(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Motions of flows (..., components, knots) on the mesh: (..., motions, *mesh.shape)."""
        component = -1 - self.mesh.dims

        def rate(motion: Motion) -> torch.Tensor:
            terms = (
                scale * self.mesh.field(coefficients.select(component, a), orders)
                for a, orders, scale in motion
            )
            return reduce(torch.add, terms)

        return torch.stack([rate(motion) for _, motion in self.motions], component)

    def rates_transposed(self, values: torch.Tensor) -> torch.Tensor:
        """The transpose of `rates`: (..., motions, *mesh.shape) to coefficients."""
        dims = self.mesh.dims
        component = -1 - dims
        parts: list[torch.Tensor | float] = [0.0] * dims
        for (_, motion), value in zip(self.motions, values.unbind(component), strict=True):
            for a, orders, scale in motion:
                parts[a] = parts[a] + scale * self.mesh.transposed(value, orders)
        return torch.stack([torch.as_tensor(part) for part in parts], component)

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
        strength = self.cell * self.local
        return strength[[kind for kind, _ in self.motions]]

    def updated(
        self, informed: torch.Tensor, energy: torch.Tensor, settings: VariationalSettings
    ) -> "Prior":
        """The prior after a step toward largest evidence.

        The strength of a place follows from all kinds of motion around it, the ratio of the kinds
        from all places. Divergence is as likely as in a plane of isotropic turbulence before the
        images: `VariationalSettings.ratio`, known as from `VariationalSettings.modes` motions.

        informed, energy (kinds, *mesh.shape): of each kind of motion: prior less posterior
            variance, and its square in the flow.
        """
        known, square = (self.local * self.cell * part for part in (informed, energy))
        around = self._number_around()
        base = self.local[0]
        strength = _gamma_mean(
            around * self.smooth(known.sum(0)).clamp(min=0),
            # over the prior variance, so that the mean is not that of the strongest motion
            around * self.smooth(square.sum(0)) / base,
        )
        change = strength / base
        whole = known.flatten(1).sum(1).clamp(min=1e-3)
        spent = (square * change).flatten(1).sum(1).clamp(min=1e-6)
        for kind, of in DIVERGENT[self.mesh.dims]:
            ratio = (self.local[kind] / self.local[of]).mean()
            whole[kind] += settings.modes
            spent[kind] += settings.modes * ratio / settings.ratio
        step = change * (whole / spent).reshape(-1, *[1] * self.mesh.dims)
        most = settings.largest_change
        step = step.clamp(1 / most, most) ** settings.relaxation
        # of a volume as far as conjugate gradients find flows
        strongest = _STRONGEST if self.mesh.dims == 2 else _cells(self.mesh) / _LEAST**2
        return self._replace(local=(self.local * step).clamp(_WEAKEST, strongest))

    def _number_around(self) -> float:
        """Nodes of the mesh that count in a Gaussian mean of the prior's width."""
        return (4 * math.pi) ** (self.mesh.dims / 2) * self.width**self.mesh.dims / self.cell

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


def _gamma_mean(known: torch.Tensor, square: torch.Tensor) -> torch.Tensor:
    """Expected strengths by place, of the likeliest gamma distribution.

    If S times the strength has a chi-square distribution of n degrees of freedom, and strengths
    are distributed as gamma of shape a and rate b, the strength of a place is expected to be
    (a + n / 2) / (b + S / 2), and a and b are those of the largest marginal likelihood (empirical
    Bayes; Berger 1985, Statistical Decision Theory, sect. 4.5).

    known: motions n about each place that the images determine.
    square: sum S of their squares.
    """
    half, energy = (part.reshape(1, -1).float() / 2 for part in (known, square))
    energy = energy.clamp(min=1e-30)
    shape = _SHAPES.to(half)[:, None]
    rate = shape * (energy / half.clamp(min=1e-9)).median()
    for _ in range(_ROUNDS):
        rate = shape / ((shape + half) / (rate + energy)).mean(1, keepdim=True)
    likelihood = shape * rate.log() - torch.lgamma(shape) + torch.lgamma(shape + half)
    likelihood = likelihood - (shape + half) * (rate + energy).log()
    best = likelihood.mean(1).argmax()[None]
    shape, rate = shape.index_select(0, best), rate.index_select(0, best)
    return ((shape + half) / (rate + energy)).reshape(known.shape).to(known)


def _cells(mesh: Mesh) -> float:
    """Cells between knots per pixel, of a mesh at half the spacing of the knots."""
    return math.prod(axis.cells / axis.size for axis in mesh.axes)


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
    vorticity = prior.by_kind(prior.rates(coefficients).square())[: dims - 1].sum(0)
    vorticity = vorticity.mean() if dims == 2 else prior.smooth(vorticity)
    local = (dims - 1) * _cells(mesh) / (vorticity + settings.least_vorticity**2) * one
    if dims == 2:
        # waves of one radian per knot have half of their variance by either order
        local[2:] *= ((axes[0].size - 1) / axes[0].cells) ** 2
        for kind, _ in DIVERGENT[dims]:
            local[kind] *= settings.ratio
    else:
        local[-1] *= settings.volume_ratio
    return prior._replace(local=local)


def refined(prior: Prior, axes: Sequence[Axis]) -> Prior:
    """A prior estimated on coarser knots, interpolated to finer ones."""
    mesh = halves(axes, prior.local)
    # from core to still air the strength changes by decades: its logarithm is smoother
    local = interpolated(prior.local.log(), prior.mesh.places, mesh.places).exp()
    return prior._replace(local=local, mesh=mesh)
