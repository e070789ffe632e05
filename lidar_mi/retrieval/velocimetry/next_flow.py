"""The flow of the next slab of air: one step from the last one, with what was learnt there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from lidar_mi.retrieval.velocimetry.agreement import agreement, flagged, unskilled
from lidar_mi.retrieval.velocimetry.band import spread
from lidar_mi.retrieval.velocimetry.band_limit import Filter
from lidar_mi.retrieval.velocimetry.brightness import normalised
from lidar_mi.retrieval.velocimetry.direct import Posterior, solved, variances
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.flow_spline import Axis, Mesh
from lidar_mi.retrieval.velocimetry.likelihood import Images, Linear, linearised
from lidar_mi.retrieval.velocimetry.prior import Prior
from lidar_mi.retrieval.velocimetry.quality import misfit_variance, usable
from lidar_mi.retrieval.velocimetry.settings import VariationalSettings
from lidar_mi.retrieval.velocimetry.warping import filtered_spline
from lidar_mi.retrieval.velocimetry.windows import Windows

# Largest step (px, of 99 in 100 pixels) after which the images are not warped again.
_SMALL = 0.15
_ROUNDS = 2
# Factor by which the misfit of the next images may differ: beyond, what was learnt does not hold.
_ALIKE = 1.5


@dataclass(frozen=True, eq=False)
class Flow:
    """A retrieved flow, and what the retrieval of the next images of such air may start from.

    Attributes
    ----------
    coefficients : torch.Tensor, shape (2, knots z, knots y)
        Displacement in dt, px.
    axes : tuple of Axis
        The knots along z and y.
    prior : Prior
        Of largest evidence.
    free : torch.Tensor, shape (kinds, *prior.mesh.shape)
        Variance of each kind of motion a priori times its strength, which hardly depends on it.
    before : torch.Tensor, shape (2, 2, *windows.count)
        Covariance of the flow a priori, px^2.
    images : Images
        Their filter, noise and weights.
    misfit : float
        Mean square of the residuals over that of the noise.
    windows : Windows
    settings : VariationalSettings
    """

    coefficients: torch.Tensor
    axes: tuple[Axis, ...]
    prior: Prior
    free: torch.Tensor
    before: torch.Tensor
    images: Images
    misfit: float
    windows: Windows
    settings: VariationalSettings

    def changed(self, change: torch.Tensor) -> "Flow":
        """The flow with a change (2, z, y), px in dt, known from elsewhere."""
        mesh = Mesh(self.axes, _pixels(self.windows, self.coefficients))
        coefficients = self.coefficients + mesh.fitted(change.to(self.coefficients))
        return replace(self, coefficients=coefficients)


def flow_of(
    posterior: Posterior, linear: Linear, images: Images, before: torch.Tensor, windows: Windows,
    settings: VariationalSettings,
) -> Flow:
    """What the next retrieval starts from, after a retrieval from scratch."""
    prior = posterior.prior
    band = posterior.band.covariance(posterior.band.factor(posterior.stiff))
    free = variances(band, prior) * prior.strength
    axes = tuple(prior.mesh.axes)
    return Flow(
        posterior.coefficients, axes, prior, free, before, images,
        _misfit(linear, torch.zeros_like(linear.slope), images), windows, settings,
    )


def next_flow(
    start: Flow, stack: Sequence[torch.Tensor], min_correlation: float
) -> tuple[Displacement, Flow] | None:
    """`variational.variational` near a flow; None where what was learnt before does not hold.

    The filter, the noise, the weights of the pixels and the prior are those of the last images. The
    errors follow the misfit. The prior makes one step to largest evidence for the next images.
    Images are read in single precision: places to 1e-5 px.

    Parameters
    ----------
    start : Flow
    stack : sequence of torch.Tensor, shape (z, y)
        Two images of the windows' size.
    min_correlation : float
        As `variational` takes it.
    """
    windows, settings, prior = start.windows, start.settings, start.prior
    images = _prepared(start.images, stack, settings)
    mesh = Mesh(start.axes, _pixels(windows, images.spline.coefficients))
    coefficients = start.coefficients
    for _ in range(_ROUNDS):
        linear = linearised(images, mesh, coefficients.float(), settings)
        posterior = solved(linear, mesh, coefficients, prior, settings, 0)
        step = mesh.field((posterior.coefficients - coefficients).float())
        coefficients = posterior.coefficients
        if float(step.abs().flatten().kthvalue(int(0.99 * step.numel())).values) < _SMALL:
            break
    else:
        return None
    worse = _misfit(linear, step, images) / start.misfit
    if not 1 / _ALIKE < worse < _ALIKE:
        return None
    centres = [windows.centres(axis).to(coefficients) for axis in range(2)]
    at_centres = Mesh(start.axes, centres)
    after = posterior.band.covariance(posterior.root)
    covariance = worse * spread(after, at_centres)
    d = at_centres.field(coefficients)
    score = agreement(linear, windows)
    found = flagged(d, covariance, start.before, score, stack, windows, min_correlation)
    found = found._replace(flag=found.flag | unskilled(found.d, covariance))
    energy = prior.by_kind(prior.rates(coefficients).square())
    informed = start.free / prior.strength - variances(after, prior)
    prior = prior.updated(informed, energy, settings)
    prior = prior._replace(divergence=prior.divergence._replace(trend=None))
    return found, replace(start, coefficients=coefficients, prior=prior)


def _pixels(windows: Windows, like: torch.Tensor) -> list[torch.Tensor]:
    return [torch.arange(n).to(like) for n in windows.shape]


def _prepared(last: Images, stack: Sequence[torch.Tensor], settings: VariationalSettings) -> Images:
    """New images with the filter, the noise and the weights of the last ones."""
    spline = last.spline
    chosen = Filter(
        spline.gain.float(), last.noise, spline.passed, spline.excess, spline.efficiency
    )
    pair = normalised(stack)
    spline = filtered_spline(pair.nan_to_num(0.0).float(), chosen, settings.filter)
    return last._replace(
        spline=spline,
        usable=usable(stack),
        time=last.time.float(),
        weight=last.weight.float(),
        stack=pair,
    )


def _misfit(linear: Linear, step: torch.Tensor, images: Images) -> float:
    """Mean square of the residuals after a step (2, z, y) in px, over that of the noise."""
    along = (linear.slope * step.to(linear.slope)).sum(0)
    rest = linear.warped + images.time.reshape(-1, 1, 1) * along
    rest = (rest - rest.mean(0)) * images.weight.sqrt()
    square = misfit_variance(rest.square().sum(0)[linear.valid].double(), len(rest))
    return square / (max(images.spline.passed, 1e-6) * linear.variance)
