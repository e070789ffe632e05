"""The flow of the next slab of air: one step from the last one, with what was learnt there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch

from lidar_mi.retrieval.flow.agreement import agreement, flagged, unskilled
from lidar_mi.retrieval.flow.band import spread
from lidar_mi.retrieval.flow.direct import (
    Posterior,
    PriorTerm,
    factor_in_single,
    form_of_slopes,
    prior_term_of,
    solved_in_single,
)
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import (
    Images,
    Linear,
    information_near,
    information_of_first,
    linearised,
    linearised_there,
    path,
)
from lidar_mi.retrieval.flow.posterior import Root
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.intensity import normalised
from lidar_mi.retrieval.images.noise_map import known_and_weight
from lidar_mi.retrieval.images.quality import informative, misfit_variance
from lidar_mi.retrieval.images.spline import Spline, splines_of_values_and_slopes
from lidar_mi.retrieval.images.windows import Windows

# Largest step (px, of 99 in 100 pixels) after which the images are not warped again, and how often
# they are at most.
_SMALL, _ROUNDS = 0.2, 2
# Factors by which the misfit and the prior's energy of the next flow may differ: beyond, what was
# learnt does not hold.
_MISFIT, _ENERGY = 1.5, 2.0


@dataclass(frozen=True, eq=False)
class Flow:
    """A retrieved flow, and what the retrieval of the next images of such air may start from.

    coefficients (2, knots z, knots y): displacement in dt, px.
    prior: of largest evidence in a retrieval from scratch.
    energy: of the flow then, in the prior's units.
    before (2, 2, *windows.count): covariance of the flow a priori, px^2.
    additional (2, 2, *windows.count): covariance in addition to the posterior's, px^2: of motion
        that the splines do not resolve (`components.differences`).
    factor (*windows.count): of the posterior covariance, by the error of the prior (`prior_check`).
    images: their filter and noise.
    local (z, y): weight of each pixel by its misfit, over that by its noise as given.
    misfit: mean square of the residuals then, over that of the noise.
    offset: along z and y, px: how far what was learnt of places (the prior's strength, `before`,
        `additional`, `factor`, `local`) has moved since.
    """

    coefficients: torch.Tensor
    prior: Prior
    energy: float
    before: torch.Tensor
    additional: torch.Tensor
    factor: torch.Tensor
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

        shift: along z and y, px; edges continue beyond.
        change (2, z, y): of the flow after this shift, px in dt, as by a model of both.
        offset: see `Flow`. Default: the last one and the shift.
        """
        axes, like = self.prior.mesh.axes, self.coefficients
        pixels = _of_pixels(axes, self.windows, like)
        flow = Mesh(axes, _back(pixels.places, shift)).field(self.coefficients) + change.to(like)
        if offset is None:
            offset = [sum(pair) for pair in zip(self.offset, shift, strict=True)]
        return replace(self, coefficients=pixels.fitted(flow), offset=offset)

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
            additional=interpolated(self.additional, centres, _back(centres, self.offset)),
            factor=interpolated(self.factor, centres, _back(centres, self.offset)),
            local=interpolated(self.local, pixels, _back(pixels, self.offset)),
            offset=(0.0, 0.0),
        )


def flow_of(
    posterior: Posterior,
    linear: Linear,
    images: Images,
    before: torch.Tensor,
    additional: torch.Tensor,
    factor: torch.Tensor,
    windows: Windows,
    settings: VariationalSettings,
) -> Flow:
    """What the next retrieval may start from, after one from scratch.

    The arguments are those of its end.
    """
    return Flow(
        posterior.coefficients,
        posterior.prior,
        _energy(posterior.prior, posterior.coefficients),
        before,
        additional,
        factor,
        images,
        images.weight / images.given_weight,
        _misfit(linear, torch.zeros_like(linear.slope), images),
        windows,
        settings,
    )


@dataclass(frozen=True, eq=False)
class ExpectedFlow:
    """The next flow before its second image is there; see `expected_flow`.

    start, placed: as expected, and with what was learnt where it is now.
    mesh: of the pixels, in single precision.
    images: of the first image alone.
    places (2, images, z, y): of the air at the pixels at mid-time in both images, px.
    first (1, z, y): value and slopes of the first image there.
    root: factor of the precision of the flow, by the information that the first image shows.
    covariance (2, 2, *windows.count): of the flow by it, px^2.
    information (z, y): on both components, see `information_near`.
    """

    start: Flow
    placed: Flow
    mesh: Mesh
    images: Images
    places: torch.Tensor
    first: tuple[torch.Tensor, ...]
    prior_term: PriorTerm
    root: Root
    covariance: torch.Tensor
    information: torch.Tensor


def expected_flow(
    start: Flow, first: torch.Tensor, noise: float | torch.Tensor | None
) -> ExpectedFlow:
    """All of `next_flow` that concerns the first image and the expected flow alone."""
    placed = start.placed()
    images = _prepared(placed, first, noise)
    axes = placed.prior.mesh.axes
    mesh = _of_pixels(axes, start.windows, images.spline.coefficients)
    places = path(mesh, start.coefficients.float(), images.time, start.settings.path_order)
    sampled = images.sample(*places[:, :1])
    slope, information = information_of_first(images, mesh, places, sampled, len(images.time))
    prior_term = prior_term_of(placed.prior, start.coefficients, start.settings.ridge)
    root = factor_in_single(form_of_slopes(information, slope, mesh) + prior_term.whole)
    # the recursion for the inverse damps rounding: 1e-5 in single precision
    inverse = root.covariance().float()
    at_centres = _of_centres(axes, start.windows, inverse)
    covariance = spread(inverse, at_centres).to(start.coefficients)
    near = information_near(slope, information, mesh)
    return ExpectedFlow(
        start, placed, mesh, images, places, sampled, prior_term, root, covariance, near
    )


def next_flow(
    start: Flow | ExpectedFlow,
    stack: Sequence[torch.Tensor],
    noise: float | torch.Tensor | None,
    min_correlation: float,
) -> tuple[Displacement, Flow] | None:
    """`variational.variational` near a flow; None where what was learnt before does not hold.

    Filter, noise, weights and prior are those learnt from scratch; the errors follow the misfit.
    Images are read in single precision: places to 1e-5 px.

    start: the expected one, or what was made of it and of the first image before.
    stack (z, y): two images of the windows' size.
    min_correlation: as `variational` takes them.
    """
    ready = start if isinstance(start, ExpectedFlow) else expected_flow(start, stack[0], noise)
    start, placed, mesh = ready.start, ready.placed, ready.mesh
    windows, settings, prior = start.windows, start.settings, placed.prior
    images = _completed(ready.images, placed, stack, noise)
    second = images.only(1).sample(*ready.places[:, 1:])
    sampled = [torch.cat(pair) for pair in zip(ready.first, second, strict=True)]
    linear = linearised_there(images, mesh, ready.places, sampled, settings)
    coefficients, prior_term = start.coefficients, ready.prior_term
    for iteration in range(_ROUNDS):
        if iteration:
            linear = linearised(images, mesh, coefficients.float(), settings)
            prior_term = prior_term.at(prior, coefficients)
        after = solved_in_single(linear, mesh, coefficients, prior_term, ready.root)
        step = mesh.field((after - coefficients).float())
        coefficients = after
        far = float(step.abs().flatten().kthvalue(int(0.99 * step.numel())).values)
        if far < _SMALL:
            break
    worse = _misfit(linear, step, images) / start.misfit
    more = _energy(prior, coefficients) / start.energy
    if not (far < _SMALL and 1 / _MISFIT < worse < _MISFIT and 1 / _ENERGY < more < _ENERGY):
        return None
    at_centres = _of_centres(prior.mesh.axes, windows, coefficients)
    # errors learnt from other images follow the misfit of these
    covariance = worse * placed.factor * _as_informed(ready, linear)
    d, score = at_centres.field(coefficients), agreement(linear, windows)
    displacement = flagged(d, covariance, placed.before, score, stack, windows, min_correlation)
    covariance = covariance + placed.additional
    flag = displacement.flag | unskilled(displacement.d, covariance)
    displacement = displacement._replace(covariance=covariance, flag=flag)
    return displacement, replace(start, coefficients=coefficients)


def _as_informed(ready: ExpectedFlow, linear: Linear) -> torch.Tensor:
    """The covariance (2, 2, *windows.count) by the information of all images.

    That by the first one, changed as the information near each window differs. With a fraction f of
    the variance before that the images removed, and r times the information, it changes by
    1 / (1 + f (r - 1)).
    """
    covariance, before, windows = ready.covariance, ready.placed.before, ready.start.windows
    known = information_near(linear.slope, linear.weight, ready.mesh)
    ratio = (known / ready.information.clamp(min=1e-30)).to(covariance)
    pixels, centres = _pixels(windows, covariance), _centres(windows, covariance)
    ratio = interpolated(ratio, pixels, centres)
    removed = 1 - covariance.diagonal().sum(-1) / before.diagonal().sum(-1)
    return covariance / (1 + removed.clamp(0, 1) * (ratio - 1))


def _of_pixels(axes: Sequence[Axis], windows: Windows, like: torch.Tensor) -> Mesh:
    return _mesh(axes, windows, _pixels, like.dtype, like.device)


def _of_centres(axes: Sequence[Axis], windows: Windows, like: torch.Tensor) -> Mesh:
    return _mesh(axes, windows, _centres, like.dtype, like.device)


@lru_cache(maxsize=8)
def _mesh(
    axes: Sequence[Axis],
    windows: Windows,
    places: Callable[[Windows, torch.Tensor], list[torch.Tensor]],
    dtype: torch.dtype,
    device: torch.device,
) -> Mesh:
    """Stored for the next slab: to make its splines takes longer than to use them."""
    return Mesh(axes, places(windows, torch.empty(0, dtype=dtype, device=device)))


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


def _prepared(start: Flow, first: torch.Tensor, noise: float | torch.Tensor | None) -> Images:
    """The first of new images with the filter and the noise of those before."""
    known, weight = known_and_weight([first], noise, start.settings.noise_width)
    image = normalised([first])
    spline, smooth = _splines(start, image)
    return start.images._replace(
        spline=spline,
        smooth=smooth,
        usable=known,
        all_usable=bool(known.all()),
        time=start.images.time.float(),
        weight=(weight * start.local).float(),
        stack=image,
    )


def _completed(
    images: Images, start: Flow, stack: Sequence[torch.Tensor], noise: float | torch.Tensor | None
) -> Images:
    """Both images, after `_prepared`."""
    known = informative(stack)
    if isinstance(noise, torch.Tensor) and noise.ndim:
        known = known & informative([noise])
    pair = normalised(stack)
    spline, smooth = _splines(start, pair[1:])
    return images._replace(
        spline=images.spline.stacked_with(spline),
        smooth=images.smooth.stacked_with(smooth),
        usable=known,
        all_usable=bool(known.all()),
        stack=pair,
    )


def _splines(start: Flow, images: torch.Tensor) -> tuple[Spline, Spline]:
    """With the filter that was learnt, in single precision."""
    finite = images.nan_to_num(0.0).float()
    chosen = start.images.chosen.to(finite)
    return splines_of_values_and_slopes(finite, chosen, start.settings.filter)


def _energy(prior: Prior, coefficients: torch.Tensor) -> float:
    """Mean over all motions and places of their squares times the prior's strength."""
    return float((prior.weights * prior.rates(coefficients).square()).mean())


def _misfit(linear: Linear, step: torch.Tensor, images: Images) -> float:
    """Mean square of the residuals after a step (2, z, y) in px, over that of the noise."""
    along = (linear.slope * step.to(linear.slope)).sum(0)
    residual = linear.warped + images.time.reshape(-1, 1, 1) * along
    residual = (residual - residual.mean(0)) * images.weight.sqrt()
    square = misfit_variance(residual.square().sum(0), linear.valid, len(residual))
    return float(square / (max(images.spline.passed, 1e-6) * linear.variance))
