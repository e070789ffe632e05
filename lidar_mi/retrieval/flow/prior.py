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
        tuple((a, tuple(n + int(axis == c) for axis, n in enumerate(orders)), sign) for a, orders, sign in motion)
        for c in range(dims)
    )


KINDS: dict[int, tuple[tuple[Motion, ...], ...]] = {
    2: (
        (_rotation(2, 0, 1),),
        (_divergence(2),),
        _gradient(_rotation(2, 0, 1)),
        _gradient(_divergence(2)),
    ),
    3: (
        (_rotation(3, 1, 2),),
        (_rotation(3, 0, 1), _rotation(3, 0, 2)),
        (_divergence(3),),
    ),
}
"""Kinds of motion by number of dimensions.

In a volume vorticity along x and across x are two kinds: the vortices of a wake lie along x.
"""


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
    """

    local: torch.Tensor
    mesh: Mesh
    width: float
    spacing: tuple[float, ...]
    trend: tuple | None = None

    @property
    def cell(self) -> float:
        """Area or volume of a cell of the mesh, px^2 or voxels."""
        # the mesh has two steps between knots
        return math.prod((axis.size - 1) / (2 * axis.cells) for axis in self.mesh.axes)

    @property
    def strength(self) -> torch.Tensor:
        return self.local

    @property
    def motions(self) -> list[tuple[int, Motion]]:
        """Every motion with the number of its kind, its terms scaled to rates in space."""
        return [
            # displacements are in pixels of their own axis, distances in those of the other
            (
                kind,
                tuple(
                    (a, orders, sign * self.spacing[a] / math.prod(s**n for s, n in zip(self.spacing, orders, strict=True)))
                    for a, orders, sign in motion
                ),
            )
            for kind, motions in enumerate(KINDS[self.mesh.dims])
            for motion in motions
        ]

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
        strength = self.cell * self.strength
        return strength[[kind for kind, _ in self.motions]]

    def updated(self, informed: torch.Tensor, energy: torch.Tensor, settings: VariationalSettings) -> "Prior":
        """The prior after a step toward largest evidence (MacKay's fixed point).

        Parameters
        ----------
        informed, energy : torch.Tensor, shape (kinds, *mesh.shape)
            Variance of each kind of motion removed by the images, and its square in the flow.
        """
        around = self._number_around()
        known = self.local * self.cell * informed
        square = self.local * self.cell * energy
        strength, _ = _strengths(
            around * self.smooth(known.sum(0)).clamp(min=0),
            around * self.smooth(square.sum(0)) / self.local[0],
        )
        change = strength / self.local[0]
        whole = known.flatten(1).sum(1).clamp(min=1e-3)
        spent = (square * change).flatten(1).sum(1).clamp(min=1e-6)
        ratio = (self.local / self.local[0]).flatten(1)[:, 0]
        if self.mesh.dims == 2:
            for kind in (1, 3):
                whole[kind] += settings.pseudo
                spent[kind] += settings.pseudo * ratio[kind] / (settings.ratio * ratio[kind - 1])
        factor = (whole / spent).reshape(-1, *[1] * self.mesh.dims)
        most = settings.largest
        step = (change * factor).clamp(1 / most, most) ** settings.relaxation
        HYPER.append([float("%.3g" % r) for r in ratio])
        return self._replace(local=(self.local * step).clamp(1e-6, 1e10))

    def _number_around(self) -> float:
        """Nodes of the mesh that a Gaussian mean of the prior's width counts."""
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


def _strengths(known, square):
    half, energy = known.reshape(1, -1) / 2, square.reshape(1, -1) / 2
    shape = SHAPES.to(half)[:, None]
    mean = (half / energy).median() * torch.ones_like(shape)
    for _ in range(_ROUNDS):
        rate = shape / mean
        rate = shape / ((shape + half) / (rate + energy)).mean(1, keepdim=True)
        mean = shape / rate
    like = shape * rate.log() - torch.lgamma(shape) + torch.lgamma(shape + half) - (shape + half) * (rate + energy).log()
    best = int(like.mean(1).argmax())
    HYPER.append((float(shape[best]), float("%.2g" % mean[best])))
    return ((shape[best] + half[0]) / (rate[best] + energy[0])).reshape(known.shape), None

SHAPES = 0.05 * 2.0 ** torch.arange(10)
HYPER=[]
_SHAPES = [0.1 * 2 ** (0.5*k) for k in range(16)]
_ROUNDS = 20


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
    strength = (dims - 1) * _cells(mesh) / (vorticity + settings.least_vorticity**2)
    local = strength * one
    if dims == 2:
        width = (axes[0].size - 1) / axes[0].cells
        local[1] *= settings.ratio
        local[2] *= width**2
        local[3] *= width**2 * settings.ratio
    else:
        local[-1] *= 100.0
    return prior._replace(local=local)


def refined(prior: Prior, axes: Sequence[Axis]) -> Prior:
    """A prior estimated on coarser knots, interpolated to finer ones."""
    mesh = halves(axes, prior.local)
    # from core to still air the strength changes by decades: its logarithm is smoother
    local = interpolated(prior.local.log(), prior.mesh.places, mesh.places).exp()
    return prior._replace(local=local, mesh=mesh, trend=None)
