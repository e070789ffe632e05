"""Variational retrieval: the smooth flow that warps the images into one another, with its errors.

The flow is a field of cubic B-splines, of images or of volumes. Its coefficients are the most
probable ones given the images and a prior of concentrated vorticity and small divergence (`prior`).
What else makes the images differ is estimated from what the fit leaves (`components`).
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.first_pass import Grid, first_pass
from lidar_mi.retrieval.flow import direct, iterative, strips
from lidar_mi.retrieval.flow.agreement import agreement, flagged, unskilled
from lidar_mi.retrieval.flow.components import differences, without_texture
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.line_offsets import LineOffsets, line_offsets
from lidar_mi.retrieval.flow.next_flow import Flow, flow_of
from lidar_mi.retrieval.flow.noise_check import variance_by_coloured_noise
from lidar_mi.retrieval.flow.other_motions import better_elsewhere
from lidar_mi.retrieval.flow.posterior import Posterior, Solver
from lidar_mi.retrieval.flow.prior import Prior, first_prior, refined
from lidar_mi.retrieval.flow.prior_check import prior_check
from lidar_mi.retrieval.flow.settings import VOLUME_VARIATIONAL, VariationalSettings
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import check_between
from lidar_mi.retrieval.images.windows import Windows, image_pair, working


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

        sum_k sum_x (I_k(x + path(u, t_k)) - m(x))^2 / (2 sigma^2)
            + 1/2 integral s(x) (L vorticity^2 + M |grad vorticity|^2
                                 + D divergence^2 + N |grad divergence|^2),

    with the images warped to mid-time along the curved paths of the flow, their mean m, so that no
    texture has to be known, and the standard deviation sigma of their noise; residuals beyond
    3 sigma count linearly. The prior's strength s(x), which may vary over
    about a template, and L, M, D, N are those of the largest evidence (`prior.Prior`). So the flow
    is smoothed little in cores and strongly around them. In volumes vorticity along x, across x and
    divergence have a strength each (`prior.KINDS`). The variance of the differences, by place and
    wavenumber, is that of noise, replaced texture, motion through the plane and motion that the
    splines do not resolve (`components.differences`). Solved by Gauss-Newton steps from a coarse
    correlation, level by level of `settings.knots`: images directly (`direct`; large ones in
    strips, `strips`), volumes by conjugate gradients (`iterative`).

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
        Standard deviation of the images' white noise, of each pixel or of all. Default: it is
        estimated with the other components of the differences.
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
        image with the mean of the others, `covariance` that of the posterior, larger where the
        prior proves wrong, plus those of motion finer than the splines, of noise that is not white
        and of offsets of lines.
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
    images that do not determine the flow. Where lines of two images have offsets, the fit is
    repeated on images without them. If offsets never explain the images, these are fitted as they
    are.
    """
    fitted: Callable[..., tuple[Displacement, Flow | None] | LineOffsets] = partial(
        _fitted,
        windows=windows,
        min_correlation=min_correlation,
        noise=noise,
        blur=blur,
        spacing=spacing,
        settings=settings,
        keep=keep,
    )
    result = fitted(stack)
    while isinstance(result, LineOffsets):
        # settled: a further fit would not change offsets that do not explain the images
        given_up = result.settled
        result = fitted(stack, sought=False) if given_up else fitted(result.images, offsets=result)
    return result


def _fitted(
    stack: Sequence[torch.Tensor],
    windows: Windows,
    min_correlation: float,
    noise: float | torch.Tensor | None,
    blur: float,
    spacing: Sequence[float] | None,
    settings: VariationalSettings | None,
    keep: bool,
    offsets: LineOffsets | None = None,
    sought: bool = True,
) -> tuple[Displacement, Flow | None] | LineOffsets:
    """`variational_and_flow` of images from which `offsets` of lines were subtracted.

    If `sought`, offsets are looked for; those that do not yet explain the images are returned in
    place of the fit.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    for image in stack[1:]:
        image_pair(stack[0], image, (2, 3))
    if settings is None:
        settings = VariationalSettings() if windows.dims == 2 else VOLUME_VARIATIONAL
    images = prepared(stack, noise, blur, settings)
    like = images.spline.coefficients[:0]
    untextured = without_texture(images, windows.template).to(like) if windows.dims == 2 else None
    pixels = [torch.arange(n).to(like) for n in windows.shape]
    flow, _ = first_pass(stack, images.smooth, windows, Grid(windows.shape, 0.0, like))
    prior: Prior | None = None
    posterior: Posterior | None = None
    unresolved = torch.zeros(windows.shape).to(like)
    levels = zip(settings.knots, settings.rounds, settings.noise_rounds, strict=True)
    for knots, rounds, noise_rounds in levels:
        axes = [Axis(n, max(2.0, knots * windows.template)) for n in windows.shape]
        mesh = Mesh(axes, pixels)
        mesh_in_single = Mesh(axes, [place.float() for place in pixels])
        solve = _solver(axes, settings)
        coefficients = mesh.fitted(flow)
        if prior is None:
            width = settings.prior_width * windows.template
            unit = spacing or (1.0,) * windows.dims
            prior = first_prior(axes, working(coefficients), width, unit, settings)
        else:
            prior = refined(prior, axes)
        in_single = images.single()
        for iteration in range(rounds):
            if posterior is not None and iteration in noise_rounds:
                coefficients_in_single = coefficients.float()
                linear = linearised(in_single, mesh_in_single, coefficients_in_single, settings)
                components = differences(
                    images,
                    linear,
                    mesh_in_single,
                    coefficients_in_single,
                    prior,
                    windows.template,
                    posterior.response,
                )
                images, unresolved = components.images, components.unresolved
                in_single = images.single()
            linear = linearised(in_single, mesh_in_single, coefficients.float(), settings)
            posterior = solve(linear, mesh_in_single, coefficients, prior, settings, iteration)
            coefficients = posterior.coefficients.to(like)
            # the first flow on coarse knots is too far off to estimate the prior from
            if iteration or len(axes) > 2 or knots != settings.knots[0]:
                prior = prior.updated(*posterior.evidence(), settings)
        flow = mesh.field(coefficients)
    assert prior is not None  # settings have a level at least
    # the posterior under the last prior; that of the loop is under the one before
    linear = linearised(in_single, mesh_in_single, coefficients.float(), settings)
    posterior = solve(linear, mesh_in_single, coefficients, prior, settings, settings.rounds[-1])
    if sought and len(stack) == 2 and windows.dims == 2 and posterior.response is not None:
        offsets = line_offsets(
            images, linear, mesh, coefficients, settings, posterior.response, offsets
        )
        if offsets and not offsets.explain:
            return offsets
    centres = [windows.centres(axis).to(like) for axis in range(windows.dims)]
    d = Mesh(mesh.axes, centres).field(posterior.coefficients.to(like))
    covariance, before = posterior.covariance(centres)
    # never narrower: one ratio scatters by half in flows of few vortices
    check = prior_check(posterior, linear, mesh_in_single)
    factor = check.factor(centres).to(covariance).clamp(min=1.0)
    covariance = factor * covariance
    score = agreement(linear, windows)
    result = flagged(d, covariance, before, score, stack, windows, min_correlation)
    # what the splines do not resolve is not in the posterior, nor noise that is not white
    eye = torch.eye(windows.dims).to(covariance)
    beyond_posterior = interpolated(unresolved.to(like), pixels, centres).to(covariance)
    noisy_lines = ""
    if windows.dims == 2 and posterior.response is not None:
        coloured, noisy_lines = variance_by_coloured_noise(
            linear, images, mesh_in_single, windows, posterior.response
        )
        beyond_posterior = beyond_posterior + coloured.to(beyond_posterior)
    additional = eye.reshape(*eye.shape, *[1] * windows.dims) * beyond_posterior
    if offsets:
        by_lines = Mesh(mesh.axes, centres).field(offsets.flows.to(like)).to(covariance)
        additional = additional + torch.einsum("nazy,nbzy->abzy", by_lines, by_lines)
        noisy_lines = offsets.names
    covariance = covariance + additional
    said = {"noise_of_lines": noisy_lines} if noisy_lines else {}
    result = result._replace(covariance=covariance, attributes=said)
    if untextured is None:
        return result, None
    untextured = interpolated(untextured, pixels, centres) > 0.5
    flag = result.flag | unskilled(result.d, covariance) | (Flag.LOW_TEXTURE * untextured).short()
    if len(stack) == 2:
        other = better_elsewhere(in_single, linear, d, windows)
        flag = flag | (Flag.OTHER_MOTION * other.to(flag.device)).short()
    result = result._replace(flag=flag)
    if untextured.double().mean() > 0.5 or not (keep and isinstance(posterior, direct.Posterior)):
        return result, None
    return result, flow_of(posterior, linear, images, before, additional, factor, windows, settings)


def _solver(axes: Sequence[Axis], settings: VariationalSettings) -> Solver:
    if len(axes) > 2:
        return iterative.solved
    return direct.solved if axes[0].knots <= settings.strips.largest else strips.solved
