"""The flow of the next slab of air: one step from the last one, with what was learnt there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from lidar_mi.retrieval.velocimetry.agreement import agreement, flagged, unskilled
from lidar_mi.retrieval.velocimetry.band import spread
from lidar_mi.retrieval.velocimetry.band_limit import Filter
from lidar_mi.retrieval.velocimetry.block_banded import Factor
from lidar_mi.retrieval.velocimetry.brightness import normalised
from lidar_mi.retrieval.velocimetry.direct import Posterior, informed, solved_in_single
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.flow_spline import Mesh, interpolated
from lidar_mi.retrieval.velocimetry.likelihood import Images, Linear, linearised, usable_and_weight
from lidar_mi.retrieval.velocimetry.prior import Prior
from lidar_mi.retrieval.velocimetry.quality import misfit_variance
from lidar_mi.retrieval.velocimetry.settings import VariationalSettings
from lidar_mi.retrieval.velocimetry.unresolved import with_unresolved
from lidar_mi.retrieval.velocimetry.warping import filtered_spline
from lidar_mi.retrieval.velocimetry.windows import Windows

# Largest step (px, of 99 in 100 pixels) after which the images are not warped again, and how often
# they are at most.
_SMALL, _ROUNDS = 0.2, 2
# Factors by which the misfit and the prior's energy of the next flow may differ: beyond, what was
# learnt does not hold.
_MISFIT, _ENERGY = 1.5, 2.0


@dataclass(frozen=True, eq=False)
class Flow:
    """A retrieved flow, and what the retrieval of the next images of such air may start from.

    Attributes
    ----------
    coefficients : torch.Tensor, shape (2, knots z, knots y)
        Displacement in dt, px.
    prior : Prior
        Of largest evidence in a retrieval from scratch.
    energy : float
        Of the flow then, in the prior's units.
    before : torch.Tensor, shape (2, 2, *windows.count)
        Covariance of the flow a priori, px^2.
    finer : torch.Tensor, shape windows.count
        Variance of motion that the splines do not resolve, px^2, see `unresolved`.
    images : Images
        Their filter and noise.
    local : torch.Tensor, shape (z, y)
        Weight of each pixel by its misfit, over that by its noise as given.
    misfit : float
        Mean square of the residuals then, over that of the noise.
    windows : Windows
    settings : VariationalSettings
    offset : (float, float)
        Along z and y, px: how far what was learnt of places (the prior's strength, `before`,
        `finer`, `local`) has moved since.
    """

    coefficients: torch.Tensor
    prior: Prior
    energy: float
    before: torch.Tensor
    finer: torch.Tensor
    images: Images
    local: torch.Tensor
    misfit: float
    windows: Windows
    settings: VariationalSettings
    offset: Sequence[float] = (0.0, 0.0)

    def moved(
        self, shift: Sequence[float], change: torch.Tensor, offset: Sequence[float] | None = None
    ) -> "Flow":
        """The flow expected where its structure has moved and changed.

        Parameters
        ----------
        shift : (float, float)
            Along z and y, px; edges continue beyond.
        change : torch.Tensor, shape (2, z, y)
            Of the flow after this shift, px in dt, as by a model of both.
        offset : (float, float), optional
            See `Flow`. Left out: the last one and the shift.
        """
        axes, like = self.prior.mesh.axes, self.coefficients
        pixels = _pixels(self.windows, like)
        flow = Mesh(axes, _back(pixels, shift)).field(self.coefficients) + change.to(like)
        if offset is None:
            offset = [sum(pair) for pair in zip(self.offset, shift, strict=True)]
        return replace(self, coefficients=Mesh(axes, pixels).fitted(flow), offset=offset)

    def placed(self) -> "Flow":
        """What was learnt of places, where it is now: interpolated once, however often it moved."""
        if not any(self.offset):
            return self
        pixels, centres = (of(self.windows, self.coefficients) for of in (_pixels, _centres))
        places = self.prior.mesh.places
        strength = interpolated(self.prior.local.log(), places, _back(places, self.offset))
        return replace(
            self,
            prior=self.prior._replace(local=strength.exp()),
            before=interpolated(self.before, centres, _back(centres, self.offset)),
            finer=interpolated(self.finer, centres, _back(centres, self.offset)),
            local=interpolated(self.local, pixels, _back(pixels, self.offset)),
            offset=(0.0, 0.0),
        )


def flow_of(
    posterior: Posterior,
    linear: Linear,
    images: Images,
    given: torch.Tensor,
    before: torch.Tensor,
    finer: torch.Tensor,
    windows: Windows,
    settings: VariationalSettings,
) -> Flow:
    """What the next retrieval may start from, after one from scratch.

    `given` is the weight (z, y) by the noise as given; the other arguments are those of its end.
    """
    return Flow(
        posterior.coefficients,
        posterior.prior,
        _energy(posterior.prior, posterior.coefficients),
        before,
        finer,
        images,
        images.weight / given,
        _misfit(linear, torch.zeros_like(linear.slope), images),
        windows,
        settings,
    )


def next_flow(
    start: Flow,
    stack: Sequence[torch.Tensor],
    noise: float | torch.Tensor | None,
    min_correlation: float,
) -> tuple[Displacement, Flow] | None:
    """`variational.variational` near a flow; None where what was learnt before does not hold.

    Filter, noise, weights and prior are those learnt from scratch; the errors follow the misfit.
    Images are read in single precision: places to 1e-5 px.

    Parameters
    ----------
    start : Flow
        The expected one.
    stack : sequence of torch.Tensor, shape (z, y)
        Two images of the windows' size.
    noise : float or torch.Tensor, optional
    min_correlation : float
        As `variational` takes them.
    """
    placed = start.placed()
    windows, settings, prior = start.windows, start.settings, placed.prior
    images = _prepared(placed, stack, noise)
    mesh = Mesh(prior.mesh.axes, _pixels(windows, images.spline.coefficients))
    coefficients = start.coefficients
    for _ in range(_ROUNDS):
        linear = linearised(images, mesh, coefficients.float(), settings)
        posterior = solved_in_single(linear, mesh, coefficients, prior, settings)
        step = mesh.field((posterior.coefficients - coefficients).float())
        coefficients = posterior.coefficients
        far = float(step.abs().flatten().kthvalue(int(0.99 * step.numel())).values)
        if far < _SMALL:
            break
    worse = _misfit(linear, step, images) / start.misfit
    more = _energy(prior, coefficients) / start.energy
    if not (far < _SMALL and 1 / _MISFIT < worse < _MISFIT and 1 / _ENERGY < more < _ENERGY):
        return None
    posterior = informed(posterior, linear, mesh)
    at_centres = Mesh(prior.mesh.axes, _centres(windows, coefficients))
    # the recursion for the inverse damps rounding: 1e-5 in single precision
    root = Factor(*(part.float() for part in posterior.root))
    in_single = Mesh(prior.mesh.axes, _centres(windows, root.root))
    covariance = worse * spread(posterior.band.covariance(root), in_single).to(coefficients)
    d, score = at_centres.field(coefficients), agreement(linear, windows)
    found = flagged(d, covariance, placed.before, score, stack, windows, min_correlation)
    found = found._replace(covariance=with_unresolved(covariance, placed.finer))
    found = found._replace(flag=found.flag | unskilled(found.d, found.covariance))
    return found, replace(start, coefficients=coefficients)


def _pixels(windows: Windows, like: torch.Tensor) -> list[torch.Tensor]:
    return [torch.arange(n).to(like) for n in windows.shape]


def _centres(windows: Windows, like: torch.Tensor) -> list[torch.Tensor]:
    return [windows.centres(axis).to(like) for axis in range(windows.dims)]


def _back(places: Sequence[torch.Tensor], shift: Sequence[float]) -> list[torch.Tensor]:
    """Where what is at places (px) now was before a shift, or the edge."""
    return [
        (axis - by).clamp(float(axis[0]), float(axis[-1]))
        for axis, by in zip(places, shift, strict=True)
    ]


def _prepared(
    start: Flow, stack: Sequence[torch.Tensor], noise: float | torch.Tensor | None
) -> Images:
    """New images with the filter and the noise of those before."""
    last, settings = start.images, start.settings
    known, weight = usable_and_weight(stack, noise, settings)
    used = last.spline
    chosen = Filter(
        used.gain.float(), last.noise, used.passed, used.excess, used.efficiency, used.noisy_slopes
    )
    pair = normalised(stack)
    return last._replace(
        spline=filtered_spline(pair.nan_to_num(0.0).float(), chosen, settings.filter),
        usable=known,
        time=last.time.float(),
        weight=(weight * start.local).float(),
        stack=pair,
    )


def _energy(prior: Prior, coefficients: torch.Tensor) -> float:
    """Mean over all motions and places of their squares times the prior's strength."""
    return float((prior.weights * prior.rates(coefficients).square()).mean())


def _misfit(linear: Linear, step: torch.Tensor, images: Images) -> float:
    """Mean square of the residuals after a step (2, z, y) in px, over that of the noise."""
    along = (linear.slope * step.to(linear.slope)).sum(0)
    rest = linear.warped + images.time.reshape(-1, 1, 1) * along
    rest = (rest - rest.mean(0)) * images.weight.sqrt()
    square = misfit_variance(rest.square().sum(0)[linear.valid].double(), len(rest))
    return square / (max(images.spline.passed, 1e-6) * linear.variance)
