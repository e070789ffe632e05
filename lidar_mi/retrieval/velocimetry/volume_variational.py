"""Volumetric variational retrieval: the smooth flow that carries one volume into the next.

The flow is a field of cubic B-splines in three dimensions. Its coefficients are the most probable
ones given the volumes and a prior that knows of air that vorticity is concentrated and divergence
small; how strongly the prior counts, and where, is found from the volumes (evidence). Normal
equations are never written down: conjugate gradients solve them, and random right-hand sides give
flows drawn from what is left open.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.velocimetry.flow_spline import Axis
from lidar_mi.retrieval.velocimetry.quality import Flag, misfit_variance
from lidar_mi.retrieval.velocimetry.volume_correlation import SLAB, settled
from lidar_mi.retrieval.velocimetry.volume_field import Volumes
from lidar_mi.retrieval.velocimetry.volume_windows import (
    VolumeDisplacement,
    VolumeWindows,
    along_x,
    bells,
    correlation,
    flags,
    hats,
    separable,
)

# Knot spacing over the template, and rounds of flow and evidence.
_KNOTS, _ROUNDS = 0.625, 5
# Divergence is first taken to have a tenth of the vorticity's standard deviation.
_RATIO = 100.0
# Width over which the prior's strength varies, over the template.
_WIDTH = 0.5
# Residuals beyond so many standard deviations pull no harder than these.
_ROBUST = 3.0
# Precision of each coefficient beside the prior's, voxel^-2: nothing for a displacement of some
# voxels.
_RIDGE = 1e-2
# Factor by which the prior may change in a round.
_LARGEST = 4.0
# Share of what the prior expects that is added to what the volumes tell: 0 is MacKay's step; all
# that they leave open would be the slower one of expectation and maximisation.
_DAMPING = 0.05
# Flows drawn from the posterior: in a round, and for the standard errors.
_DRAWS, _FINAL_DRAWS = 4, 16
# Conjugate gradients end at this residual over the first one, or after so many steps.
_TOLERANCE, _LOOSE, _STEPS = 1e-2, 1e-1, 60

_VALUE = (0, 0, 0)
_SLOPES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
# The vorticity along x, y, z, up to sign: (component, axis of its derivative) less another.
_CURL = (((1, 2), (2, 1)), ((0, 1), (1, 0)), ((0, 2), (2, 0)))


class Knots(NamedTuple):
    """Cubic B-splines in x, z, y over the voxels, and their values on a rectangular mesh.

    `bases[order][axis]` (place, knot) are the splines' derivatives of this order at the places.
    """

    axes: tuple[Axis, Axis, Axis]
    places: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    bases: tuple[list[torch.Tensor], list[torch.Tensor]]

    @classmethod
    def at(cls, axes, places) -> "Knots":
        bases = [[axis.basis(p, order) for axis, p in zip(axes, places)] for order in (0, 1)]
        return cls(tuple(axes), tuple(places), tuple(bases))

    def part(self, here: slice) -> "Knots":
        """The same at some of the rows of constant z."""
        cut = [[b[0], b[1][here], b[2]] for b in self.bases]
        return self._replace(
            places=(self.places[0], self.places[1][here], self.places[2]), bases=tuple(cut)
        )

    def field(self, coefficients: torch.Tensor, order=_VALUE) -> torch.Tensor:
        """Derivative of coefficients (..., knots) on the mesh."""
        return separable(coefficients, [self.bases[n][axis] for axis, n in enumerate(order)])

    def pulled(self, values: torch.Tensor, order=_VALUE) -> torch.Tensor:
        """The transpose of `field`: values (..., mesh) to coefficients."""
        return separable(values, [self.bases[n][axis].T for axis, n in enumerate(order)])

    def slopes(self, coefficients: torch.Tensor) -> list[torch.Tensor]:
        """First derivatives along x, z, y of coefficients (..., knots) on the mesh."""
        (x, z, y), (dx, dz, dy) = self.bases
        line = coefficients @ y.T
        return [along_x(z @ line, dx), along_x(dz @ line, x), along_x(z @ (coefficients @ dy.T), x)]

    def slopes_pulled(self, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """The transpose of `slopes`: coefficients from three fields (..., mesh)."""
        (x, z, y), (dx, dz, dy) = self.bases
        along, up, across = (along_x(v, m.T) for v, m in zip(values, (dx, x, x)))
        return (z.T @ along + dz.T @ up) @ y + (z.T @ across) @ dy

    def fitted(self, flow: torch.Tensor) -> torch.Tensor:
        """Coefficients of the splines nearest to a flow (3, mesh)."""
        solvers = []
        for basis in self.bases[0]:
            square = basis.T @ basis
            square = square + 1e-6 * torch.eye(
                len(square), dtype=square.dtype, device=square.device
            )
            solvers.append(torch.linalg.solve(square, basis.T))
        return separable(flow, solvers)


class Prior(NamedTuple):
    """Vorticity along x, across x, and divergence are white noise, each of variance 1 / strength.

    Attributes
    ----------
    strength : torch.Tensor, shape (3, mesh)
        In this order. The vortices of a wake lie along x: it is likely there that there is much
        vorticity along x and little across.
    volume : float
        Of a cell of the mesh, voxels.
    """

    strength: torch.Tensor
    volume: float

    @property
    def weights(self) -> torch.Tensor:
        """(4, mesh): of the squares of what `_curl_and_divergence` gives."""
        along, across, divergence = self.volume * self.strength
        return torch.stack([along, across, across, divergence])


class Data(NamedTuple):
    """What the volumes say on the flow, about a flow.

    `gradient` (3, knots) of the log-likelihood; `slope` (3, voxels) of the mean volume and the
    `weight` (voxels) of its products in the second derivative; `bend` (3, 3, mesh) that derivative
    lumped to the mesh; `carried` volumes and where all are `seen`, on the voxels.
    """

    gradient: torch.Tensor
    slope: torch.Tensor
    weight: torch.Tensor
    bend: torch.Tensor
    carried: torch.Tensor
    seen: torch.Tensor


def fitted_flow(
    images: Volumes,
    windows: VolumeWindows,
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    min_correlation: float = 0.5,
    seed: int = 0,
) -> VolumeDisplacement:
    """Displacement of every window's centre in the most probable flow between the volumes.

    Least is, over the flow u (displacement in dt) as B-splines,

        sum_k sum_x (I_k(x + path(u, t_k)) - mean_k)^2 / (2 s^2)
            + 1/2 integral L1(x) w_x^2 + L2(x) (w_y^2 + w_z^2) + L3(x) (div u)^2,

    with the vorticity w, as in `variational.variational`, whose ideas these are: volumes carried to
    mid-time along curved paths, residuals beyond 3 s count linearly, L1 to L3 of largest evidence
    (MacKay 1992, Neural Comput. 4, 415-447), so that each kind of motion is smoothed as the volumes
    ask for where they do. Gauss-Newton steps by conjugate gradients on knots 0.625 templates
    apart, from the flow of `volume_correlation.settled`. The second derivative is lumped to a mesh of half a knot spacing; the
    gradient, and so the flow itself, is exact. What the volumes leave open is measured by flows
    drawn from the posterior (Papandreou & Yuille 2010: solutions for a right-hand side with its
    covariance): variances are means over these and over half a template, good to some 10 %.

    Parameters
    ----------
    images : Volumes
        Two or more, each dt after the one before; mid-time is that of all.
    windows : VolumeWindows
        Where vectors are wanted; the template also sets the scale of the knots.
    spacing : (float, float, float)
        Of the voxels along x, z, y, in any unit: curl and divergence are those in space.
    min_correlation : float
        Vectors are flagged where volumes carried to mid-time correlate by less than half way from
        this to 1.
    seed : int
        Of the drawn flows.
    """
    like = images.coefficients[:0]
    draw = torch.Generator(device=like.device).manual_seed(seed)
    number = len(images.coefficients)
    time = torch.arange(number, dtype=like.dtype, device=like.device)
    time = time - time.mean()
    axes = [Axis(n, max(2.0, _KNOTS * windows.template)) for n in images.shape]
    voxels = Knots.at(axes, [torch.arange(n).to(like) for n in images.shape])
    mesh = Knots.at(axes, [_halves(axis, like) for axis in axes])
    known, flow, _ = settled(images, windows)
    places = [known.centres(axis).to(like) for axis in range(3)]
    coefficients = voxels.fitted(_on(flow.to(like), places, voxels.places))
    prior = _prior(coefficients, mesh, spacing)
    for turn in range(_ROUNDS):
        data = _linear(images, voxels, mesh, coefficients, time)
        coefficients = _step(data, voxels, mesh, coefficients, prior, spacing)
        if turn:
            drawn = _drawn(data, mesh, prior, spacing, _DRAWS, draw)
            prior = _improved(prior, mesh, coefficients, drawn, spacing, _WIDTH * windows.template)
    data = _linear(images, voxels, mesh, coefficients, time)
    coefficients = _step(data, voxels, mesh, coefficients, prior, spacing)
    (open_,) = _drawn(data, mesh, prior, spacing, _FINAL_DRAWS, draw, before=False)
    variance = _smooth(mesh.field(open_).square().mean(0), mesh.places, _WIDTH * windows.template)
    return _finished(images, data, axes, coefficients, variance, mesh, windows, min_correlation)


def _on(values: torch.Tensor, known, places) -> torch.Tensor:
    """Values (..., known places) at other places, linearly between."""
    return separable(values, [hats(k, p) for k, p in zip(known, places)])


def _halves(axis: Axis, like: torch.Tensor) -> torch.Tensor:
    """Middles of the halves of an axis' cells, voxels."""
    number = torch.arange(2 * axis.cells, dtype=like.dtype, device=like.device)
    return (number + 0.5) * (axis.size - 1) / (2 * axis.cells)


def _curl_and_divergence(knots: Knots, coefficients: torch.Tensor, spacing) -> torch.Tensor:
    """(..., 4, mesh): three components of the vorticity and the divergence, in space."""
    slopes = knots.slopes(coefficients)

    def rate(a, b):
        return slopes[b].select(-4, a) * (spacing[a] / spacing[b])

    parts = [rate(*first) - rate(*second) for first, second in _CURL]
    return torch.stack([*parts, rate(0, 0) + rate(1, 1) + rate(2, 2)], -4)


def _curl_and_divergence_pulled(knots: Knots, values: torch.Tensor, spacing) -> torch.Tensor:
    """The transpose: (..., 4, mesh) to coefficients (..., 3, knots)."""
    *vorticity, divergence = values.unbind(-4)
    part = {(a, a): divergence for a in range(3)}
    for value, (first, second) in zip(vorticity, _CURL):
        part[first], part[second] = value, -value
    return knots.slopes_pulled(
        [
            torch.stack([part[a, b] * (spacing[a] / spacing[b]) for a in range(3)], -4)
            for b in range(3)
        ]
    )


def _linear(images: Volumes, voxels: Knots, mesh: Knots, coefficients, time) -> Data:
    """What the volumes say about a flow.

    Carried along x + t u + t^2 / 2 (u . grad) u + t^3 / 6 of the same twice, with second
    derivatives of u left out of the last: off by less than 0.01 voxel for 3 voxels of displacement
    that change over 8.
    """
    like = coefficients
    shape = tuple(len(p) for p in voxels.places)
    slope = like.new_empty(3, *shape)
    pull, misfit = like.new_empty(shape), like.new_empty(shape)
    carried = like.new_empty(len(time), *shape)
    seen = torch.empty(shape, dtype=torch.bool, device=like.device)
    planes = max(1, SLAB // (shape[0] * shape[2]))
    t = time[:, None, None, None]
    for start in range(0, shape[1], planes):
        here = (slice(None), slice(start, start + planes))
        part = voxels.part(here[1])
        u = part.field(coefficients)
        slopes = part.slopes(coefficients)
        twice = sum(slopes[b] * u[b] for b in range(3))
        thrice = sum(slopes[b] * twice[b] for b in range(3))
        grid = torch.meshgrid(*part.places, indexing="ij")
        place = [
            x + t * u[a] + t**2 / 2 * twice[a] + t**3 / 6 * thrice[a] for a, x in enumerate(grid)
        ]
        value, steep, known = images.sample(place)
        rest = value - value.mean(0)
        slope[:, *here] = steep.mean(1)
        pull[here] = -(t * rest).sum(0)
        misfit[here] = rest.square().sum(0)
        seen[here] = known.all(0)
        carried[:, *here] = value
    # what no flow explains counts as noise: volumes are never taken to be better than they fit
    found = misfit_variance(misfit[seen], len(time)) / images.passed
    variance = max(images.noise**2, found, 1e-12)
    off = (misfit / ((len(time) - 1) * images.passed * variance)).sqrt()
    trust = _ROBUST / off.clamp(min=_ROBUST) * seen / variance
    weight = float(time.square().sum()) / images.excess * trust
    lumps = [hats(m, p).T for m, p in zip(mesh.places, voxels.places)]
    bend = like.new_empty(3, 3, *(len(p) for p in mesh.places))
    for a, b in _PAIRS:
        bend[a, b] = bend[b, a] = separable(weight * slope[a] * slope[b], lumps)
    return Data(voxels.pulled(pull * trust * slope), slope, weight, bend, carried, seen)


def _step(
    data: Data, voxels: Knots, mesh: Knots, coefficients, prior: Prior, spacing
) -> torch.Tensor:
    """Coefficients after one Gauss-Newton step."""
    weights = prior.weights

    def applied(c):
        along = (data.slope * voxels.field(c)).sum(-4, keepdim=True)
        return voxels.pulled(along * data.weight * data.slope) + _stiff(c, mesh, weights, spacing)

    right = data.gradient - _stiff(coefficients[None], mesh, weights, spacing)[0]
    ready = _preconditioner(data.bend, weights, mesh, spacing)
    return coefficients + _conjugate_gradients(applied, right[None], ready)[0]


def _drawn(
    data: Data,
    mesh: Knots,
    prior: Prior,
    spacing,
    number: int,
    draw: torch.Generator,
    before: bool = True,
) -> list[torch.Tensor]:
    """Flows (number, 3, knots) drawn from the prior, if wanted, and from what stays open of it.

    Both from the same random numbers: where the volumes tell nothing they are alike.
    """
    weights, like = prior.weights, data.gradient

    def normal(*shape):
        return torch.randn(number, *shape, generator=draw, dtype=like.dtype, device=like.device)

    def solved(bend, right):
        def applied(c):
            found = mesh.pulled(torch.einsum("ab...,nb...->na...", bend, mesh.field(c)))
            return found + _stiff(c, mesh, weights, spacing)

        ready = _preconditioner(bend, weights, mesh, spacing)
        return _conjugate_gradients(applied, right, ready, _LOOSE)

    # right-hand sides whose covariance is the second derivative
    shape = weights.shape[1:]
    right = _curl_and_divergence_pulled(mesh, weights.sqrt() * normal(4, *shape), spacing)
    right = right + _RIDGE**0.5 * normal(*like.shape)
    flows = [solved(torch.zeros_like(data.bend), right)] if before else []
    root = _root(data.bend.movedim((0, 1), (-2, -1))).movedim((-2, -1), (0, 1))
    right = right + mesh.pulled(torch.einsum("ab...,nb...->na...", root, normal(3, *shape)))
    return [*flows, solved(data.bend, right)]


def _stiff(coefficients: torch.Tensor, mesh: Knots, weights: torch.Tensor, spacing) -> torch.Tensor:
    """The prior's second derivative times coefficients (n, 3, knots)."""
    smooth = weights * _curl_and_divergence(mesh, coefficients, spacing)
    return _curl_and_divergence_pulled(mesh, smooth, spacing) + _RIDGE * coefficients


def _root(matrix: torch.Tensor) -> torch.Tensor:
    """A square root of positive semidefinite 3 x 3 matrices."""
    unit = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    floor = 1e-5 * matrix.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-20
    return torch.linalg.cholesky(matrix + floor[..., None, None] * unit)


def _preconditioner(full: torch.Tensor, weights: torch.Tensor, mesh: Knots, spacing):
    """Each knot's own 3 x 3 block, inverted."""
    squares = Knots(mesh.axes, mesh.places, tuple([b.square() for b in row] for row in mesh.bases))
    block = squares.pulled(full)
    for a in range(3):
        for b in range(3):
            weight = weights[3 if a == b else 0] * (spacing[a] / spacing[b]) ** 2
            block[a, a] += squares.pulled(weight, _SLOPES[b])
        block[a, a] += _RIDGE
    inverse = torch.linalg.inv(block.movedim((0, 1), (-2, -1)).double()).to(full)
    inverse = inverse.movedim((-2, -1), (0, 1)).contiguous()
    return lambda c: torch.einsum("abxzy,nbxzy->naxzy", inverse, c)


def _conjugate_gradients(
    applied, right: torch.Tensor, preconditioned, tolerance: float = _TOLERANCE
) -> torch.Tensor:
    """Solutions (n, ...) of a symmetric positive system for right-hand sides (n, ...)."""

    def product(a, b):
        return (a * b).flatten(1).sum(1)[:, None, None, None, None]

    solution = torch.zeros_like(right)
    rest = right
    ahead = preconditioned(rest)
    direction = ahead
    energy = product(rest, ahead)
    goal = tolerance**2 * energy
    for _ in range(_STEPS):
        forward = applied(direction)
        # a system that is solved already takes no more steps
        length = energy / product(direction, forward).clamp(min=1e-30)
        solution = solution + length * direction
        rest = rest - length * forward
        ahead = preconditioned(rest)
        before, energy = energy, product(rest, ahead)
        if bool((energy <= goal).all()):
            break
        direction = ahead + energy / before.clamp(min=1e-30) * direction
    return solution


def _prior(coefficients, mesh: Knots, spacing) -> Prior:
    """One as strong everywhere as a flow says."""
    volume = math.prod((axis.size - 1) / (2 * axis.cells) for axis in mesh.axes)
    vorticity = _curl_and_divergence(mesh, coefficients, spacing)[:3].square().sum(0)
    freedom = 2 * math.prod(axis.knots / len(p) for axis, p in zip(mesh.axes, mesh.places))
    strength = freedom / volume / (float(vorticity.mean()) + 1e-6)
    one = torch.full_like(vorticity, strength)
    return Prior(torch.stack([one, one, _RATIO * one]), volume)


def _improved(prior: Prior, mesh: Knots, coefficients, drawn, spacing, width: float) -> Prior:
    """The prior nearer to the one of largest evidence (MacKay's fixed point).

    There each kind of motion has the energy that the prior expects less what the volumes leave
    open, both from flows that were drawn.
    """
    expected, left, energy = (
        _smooth(
            _by_kind(prior.weights * _curl_and_divergence(mesh, c, spacing).square()).mean(0),
            mesh.places,
            width,
        )
        for c in (*drawn, coefficients[None])
    )
    # added to both, for what is drawn has noise of its own
    more = _DAMPING * expected
    change = ((expected - left).clamp(min=0) + more) / (energy + more)
    return prior._replace(strength=prior.strength * change.clamp(1 / _LARGEST, _LARGEST))


def _by_kind(values: torch.Tensor) -> torch.Tensor:
    """(..., 4, mesh) of vorticity's components and divergence to (..., 3, mesh) as in `Prior`."""
    along, *across, divergence = values.unbind(-4)
    return torch.stack([along, sum(across), divergence], -4)


def _smooth(values: torch.Tensor, places, width: float) -> torch.Tensor:
    """A Gaussian mean of this standard deviation (voxels) over a mesh."""
    kernels = []
    for place in places:
        kernel = torch.exp(-((place[:, None] - place) / width).square() / 2)
        kernels.append(kernel / kernel.sum(1, keepdim=True))
    return separable(values, kernels)


def _finished(
    images: Volumes,
    data: Data,
    axes,
    coefficients,
    variance,
    mesh: Knots,
    windows: VolumeWindows,
    min_correlation: float,
) -> VolumeDisplacement:
    like = coefficients
    centres = [windows.centres(axis).to(like) for axis in range(3)]
    d = Knots.at(axes, centres).field(coefficients)
    variance = _on(variance, mesh.places, centres)
    score, share = correlation(data.carried, data.seen, bells(windows, windows.template / 3, like))
    at = [c.round().long() for c in centres]
    finite = images.usable.all(0)[at[0]][:, at[1]][:, :, at[2]]
    flag = flags(d, variance, score, share, finite, (1 + min_correlation) / 2)
    nothing = (flag & (Flag.NO_MATCH | Flag.NON_FINITE_INPUT)) != 0
    d, variance = (torch.where(nothing, torch.nan, part.double()) for part in (d, variance))
    return VolumeDisplacement(d, variance, score.nan_to_num(0.0), flag)
