"""Variational retrieval: the smooth flow that warps the images into one another, with its errors.

The flow is a field of cubic B-splines, of images or of volumes. Its coefficients are the most
probable ones given the images and a prior of concentrated vorticity and small divergence. The
prior's strength, which varies over the image, is itself estimated from the images (evidence).
"""

from collections.abc import Callable, Sequence

import torch

from lidar_mi.retrieval.correlation.first_pass import Grid, first_pass
from lidar_mi.retrieval.flow import direct, iterative, strips
from lidar_mi.retrieval.flow.agreement import agreement, flagged, unskilled
from lidar_mi.retrieval.flow.components import estimated
from lidar_mi.retrieval.flow.coherent_change import residual_operator
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.misfit import with_local_noise
from lidar_mi.retrieval.flow.next_flow import Flow, flow_of
from lidar_mi.retrieval.flow.prior import Prior, first_prior, refined
from lidar_mi.retrieval.flow.settings import VOLUME_VARIATIONAL, VariationalSettings
from lidar_mi.retrieval.flow.unresolved import flows_of_noise, unresolved_variance, with_unresolved
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import SMALL, Flag, check_between, no_skill
from lidar_mi.retrieval.images.windows import Windows, image_pair, working

# Structure is assumed to move this many times as far otherwise than the air as was found, and the
# flow may then change by this fraction of its spread. Smoke without texture, of the true second
# states of `validation/coverage.py`: 0.19 to 0.7; with texture of 2 % or more: 0.05 at most.
_FARTHER, _ALIKE = 10.0, 0.1
# Variance over a vector's own by which the flow changes by chance if the prior's strength is made
# more even (in the cases of ``validation/coverage.py`` with noise and texture it is 0.1 to 0.3),
# and times that what is beyond it counts. Chosen on seeds 41 to 46 of these cases: errors of smoke
# without texture have a variance of 1.34 of their standard errors (once, beyond 0.5: 1.54), others
# change by 0.04 at most.
_CHANCE, _COUNTS = 0.2, 2.0


def variational(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    more: Sequence[torch.Tensor] = (),
    min_correlation: float = 0.5,
    noise: float | torch.Tensor | None = None,
    blur: float = 0.0,
    spacing: Sequence[float] | None = None,
    settings: VariationalSettings | None = None,
) -> Displacement:
    """Displacement of every window's centre in the most probable flow between the images.

    Minimised over the flow u (displacement in dt) as B-splines is

        sum_k sum_x (I_k(x + path(u, t_k)) - mean_k)^2 / (2 s^2)
            + 1/2 integral L(x) vorticity^2 + divergence^2 / (1 / D + 1 / (q L(x))),

    with the images band-limited (`spline.band_limited`) and warped to mid-time along the curved
    paths of the flow, so that no texture has to be known; residuals beyond 3 s count linearly.
    The prior's strength L(x), which may vary over about a template, D and q are those of the
    largest evidence: the energy of vorticity and of divergence is as large as the prior
    expects, of what the images inform (MacKay 1992, Neural Comput. 4, 415-447). So the flow is
    smoothed little in cores and strongly around them. In volumes vorticity along x, across x and
    divergence each have a strength L(x) (`prior.KINDS`). Solved by Gauss-Newton steps from a coarse
    correlation, level by level of `settings.knots`: images directly (`direct`; large
    ones in strips, `strips`), volumes by
    conjugate gradients (`iterative`).

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y), or (x, z, y) of volumes
        On one device, where the result stays too. Brightness may differ by a factor and an offset,
        which are fitted again for every flow, from the air that is valid in all images.
    template, search, stride : int
        Pixels, see `windows.Windows`: the positions of the vectors, and the range of the first
        correlation (see `multipass`); the template also sets the scale of the knots.
    more : sequence of torch.Tensor
        Further images, each dt after the one before. Mid-time is then that of the whole burst.
    min_correlation : float
        Vectors are flagged where the images warped to mid-time correlate over a template by less
        than half way from this to 1: a flow fitted to unrelated textures correlates them to 0.7.
    noise : float or torch.Tensor, optional
        Standard deviation of the images' white noise, of each pixel or of all; default: from the
        images' spectra. Where images warped by the flow differ by more, their misfit is used.
    blur : float
        Standard deviation, px, of a Gaussian that the instrument blurred the images by. They are
        then sharpened before they are warped, as far as noise allows: shear in cores rotates the
        blur with the texture, which is an error of 25 % there for a blur of 1 px.
    spacing : sequence of float, optional
        Of the pixels along each axis, in any unit: vorticity and divergence are those in space.
        Default: square pixels.
    settings : VariationalSettings, optional
        Default: those of images or of volumes.

    Returns
    -------
    Displacement
        Wind times dt at the windows' centres at mid-time. `score` is the smallest correlation of an
        image with the mean of the others, `covariance` that of the posterior, from noise, misfit
        and prior, and of motion finer than the splines (`unresolved`), half of it in vortex cores.
        In images whose noise is given it knows how little is known of the distribution of the
        prior's strength (`prior.Prior.evened`).
        On undersampled images displacements have an error that is correlated among
        neighbours: up to 0.04 px on particles of 2 px (1/e^2), 0.01 px of 2.5 px, none on larger
        ones.

    Raises
    ------
    InputError
        Sizes, threshold or noise out of range; images that differ in size.
    """
    return variational_and_flow(
        [image1, image2, *more],
        Windows(tuple(image1.shape), template, search, stride),
        min_correlation,
        noise,
        blur,
        spacing,
        settings,
    )[0]


def variational_and_flow(
    stack: Sequence[torch.Tensor],
    windows: Windows,
    min_correlation: float = 0.5,
    noise: float | torch.Tensor | None = None,
    blur: float = 0.0,
    spacing: Sequence[float] | None = None,
    settings: VariationalSettings | None = None,
    *,
    keep: bool = False,
) -> tuple[Displacement, Flow | None]:
    """`variational`, and if asked what the retrieval of the next images may start from.

    There is none for volumes, for images of more than `settings.strips.largest` knots, and for
    images that do not determine the flow.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    for image in stack[1:]:
        image_pair(stack[0], image, (2, 3))
    if settings is None:
        settings = VariationalSettings() if windows.dims == 2 else VOLUME_VARIATIONAL
    images = prepared(stack, noise, blur, settings)
    given_weight = images.weight
    like = images.spline.coefficients[:0]
    pixels = [torch.arange(n).to(like) for n in windows.shape]
    flow, _ = first_pass(stack, images.smooth, windows, Grid(windows.shape, 0.0, like))
    last = len(settings.knots) - 1
    prior: Prior | None = None
    posterior: direct.Posterior | strips.Posterior | iterative.Posterior | None = None
    finer = None
    for level, (knots, rounds) in enumerate(zip(settings.knots, settings.rounds, strict=True)):
        separation = max(2.0, knots * windows.template)
        axes = [Axis(n, separation) for n in windows.shape]
        mesh, single = Mesh(axes, pixels), Mesh(axes, [place.float() for place in pixels])
        solve = _solver(axes, settings)
        coefficients = mesh.fitted(flow)
        if prior is None:
            unit = (1.0,) * windows.dims
            wide = settings.prior_width * windows.template
            prior = first_prior(axes, working(coefficients), wide, spacing or unit, settings)
        else:
            prior = refined(prior, axes)
        in_single = images.single()
        for iteration in range(rounds):
            if iteration in settings.noise_rounds[level]:
                linear = linearised(images, mesh, coefficients, settings)
                images, finer = estimated(
                    images, linear, mesh, coefficients, posterior, prior, separation, windows.template
                )
                in_single = images.single()
            linear = linearised(in_single, single, coefficients.float(), settings)
            posterior = solve(linear, single, coefficients, prior, settings, iteration)
            coefficients = posterior.coefficients.to(like)
            # the first flow on coarse knots is too far off to estimate the prior from
            if iteration or level:
                prior = prior.updated(*posterior.evidence(), settings)
        flow = mesh.field(coefficients)
    assert prior is not None  # settings have a level at least
    linear = linearised(images, mesh, coefficients, settings)
    posterior = solve(linear, mesh, coefficients, prior, settings, settings.rounds[-1])
    flow = mesh.field(posterior.coefficients.to(like))
    from lidar_mi.retrieval.flow.components import DEBUG
    res=(linear.warped-linear.warped.mean(0)).square().sum(0)*images.weight/images.noise**2
    dd=(images.time.reshape(-1,1,1)*linear.warped).sum(0)/images.time.square().sum()*images.weight.sqrt()*linear.valid
    from lidar_mi.retrieval.images.band_limit import radii, shell_means
    from lidar_mi.retrieval.images.spline import transform_sizes
    sz=transform_sizes(images.spline.shape,images.spline.settings); _,sh=radii(tuple(sz),images.spline.shape,dd.dtype,dd.device)
    den,_=shell_means(dd[None]*images.time.square().sum().sqrt()/images.noise,sh,sz,5)
    DEBUG.append({"chi2":float(res[linear.valid].mean()),**{f"s{i}":float(den[i]) for i in range(0,len(den),8)}})
    centres = [windows.centres(axis).to(like) for axis in range(windows.dims)]
    at_centres = Mesh(mesh.axes, centres)
    d = at_centres.field(posterior.coefficients.to(like))
    covariance, before = posterior.covariance(centres)
    score = agreement(linear, windows)
    found = flagged(d, covariance, before, score, stack, windows, min_correlation)
    from lidar_mi.retrieval.flow.components import DEBUG; DEBUG.append({"post": float(covariance.diagonal().mean()**.5*5),"fin":float(finer.mean().clamp(min=0)**.5*5)})
    finer = interpolated(finer, pixels, centres)
    additional = with_unresolved(torch.zeros_like(covariance), finer)
    covariance = covariance + additional
    found = found._replace(covariance=covariance)
    if windows.dims > 2:
        return found, None
    found = found._replace(flag=found.flag | unskilled(found.d, covariance))
    if not (keep and isinstance(posterior, direct.Posterior)):
        return found, None
    return found, flow_of(
        posterior, linear, images, given_weight, before, additional, windows, settings
    )


def _beyond_chance(off: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Covariance of a flow's change (components, ...) where it is more than noise makes of it."""
    square = off.square().sum(0)
    chance = _CHANCE * covariance.diagonal().sum(-1)
    excess = _COUNTS * ((square - chance) / square.clamp(min=1e-30)).clamp(min=0.0)
    return excess * off[:, None] * off


def _differ(flow: torch.Tensor, other: torch.Tensor, fraction: float) -> bool:
    """Whether two flows (2, z, y) differ by more than a fraction of the first one's spread, rms.

    And by more than what is small for any wind: uniform wind has no spread.
    """
    about = flow - flow.mean((1, 2), keepdim=True)
    limit = max(fraction**2 * float(about.square().mean()), SMALL**2)
    return float((other - flow).square().mean()) > limit


def _solver(
    axes: Sequence[Axis], settings: VariationalSettings
) -> Callable[..., direct.Posterior | strips.Posterior | iterative.Posterior]:
    if len(axes) > 2:
        return iterative.solved
    return direct.solved if axes[0].knots <= settings.strips.largest else strips.solved
