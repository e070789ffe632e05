"""Variational retrieval: the smooth flow that carries one image into the other, with its errors.

The flow is a field of cubic B-splines. Its coefficients are the most probable ones given the
images and a prior that knows of air that vorticity is concentrated and divergence small; how
strongly the prior counts, and where, is itself found from the images (evidence).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch.nn.functional import max_pool2d

from lidar_mi.retrieval.velocimetry.block_tridiagonal import Factor
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.flow_spline import Axis, FlowSpline, Mesh
from lidar_mi.retrieval.velocimetry.multipass import Grid, first_pass, window_sums
from lidar_mi.retrieval.velocimetry.quality import Flag, check_between, misfit_variance, non_finite
from lidar_mi.retrieval.velocimetry.warping import (
    Spline,
    averaged,
    band_limited,
    levelled,
    mismatch,
    rms,
)
from lidar_mi.retrieval.velocimetry.windows import Windows, image_pair, working

# Rounds of flow and evidence on coarse and on fine knots, whose spacing is this over the template.
_COARSE, _FINE = (1.25, 6), (0.5, 4)
# Round on fine knots before which noise is taken from what the images do not share.
_WEIGHED = 2
# Divergence is first taken to have a tenth of the vorticity's standard deviation.
_RATIO = 100.0
# Divergence is taken to have 0.3 % of the standard deviation of vorticity, or more: images of weak
# texture that show none do not say that there is none.
_MOST_RATIO = 1e5
# Width over which the prior's strength varies, over the template.
_WIDTH = 0.5
# Residuals beyond so many standard deviations pull no harder than these.
_ROBUST = 3.0
# Precision of each coefficient beside the prior's, px^-2: nothing for a displacement of some px.
_RIDGE = 1e-4
# Factor by which the prior may change in a round.
_LARGEST, _LARGEST_DIVERGENCE = 4.0, 16.0
# Width over which the misfit is averaged, over the template; px for what is known of the noise.
_MISFIT_WIDTH, _NOISE_WIDTH = 0.75, 3.0
# Terms of the path's series in time.
_PATH_ORDER = 6
# Vorticity and divergence: (component, (order z, order y), sign) of their terms. Components: z, y.
_VORTICITY = ((0, (0, 1), 1.0), (1, (1, 0), -1.0))
_DIVERGENCE = ((0, (1, 0), 1.0), (1, (0, 1), 1.0))


class Images(NamedTuple):
    """What the flow has to explain.

    Attributes
    ----------
    spline : Spline
        Of the images, band-limited.
    usable : torch.Tensor of bool, shape (images, z, y)
        Away from non-finite pixels.
    time : torch.Tensor, shape (images,)
        From mid-time, in units of dt.
    noise : float
        Standard deviation of the images' white noise.
    trust : torch.Tensor, shape (z, y)
        Mean variance of the noise over its own at each pixel.
    stack : torch.Tensor, shape (images, z, y)
        The images, of one brightness.
    blur : float
        Standard deviation of the Gaussian that blurred the images, px.
    weighed : bool
        Whether noise holds the misfit at each place already.
    """

    spline: Spline
    usable: torch.Tensor
    time: torch.Tensor
    noise: float
    trust: torch.Tensor
    stack: torch.Tensor
    blur: float
    weighed: bool = False


class Linear(NamedTuple):
    """The images about a flow: what they say on its change.

    `slope` (2, z, y) of the mean of the images carried to mid-time, `pull` (2, z, y) down the
    misfit's gradient, `weight` that of the slopes' products in the second derivative, `variance`
    of a difference from the mean, `carried` the images at mid-time, of one brightness, and `seen`
    where all of them are.
    """

    slope: torch.Tensor
    pull: torch.Tensor
    weight: torch.Tensor
    variance: float
    carried: torch.Tensor
    seen: torch.Tensor


class Prior(NamedTuple):
    """Vorticity and divergence are white noise of variance 1 / strength and 1 / divergence.

    Attributes
    ----------
    strength : torch.Tensor
        Of vorticity, on the mesh.
    divergence : float
        Strength of the divergence where there is no vorticity, as of wind through the plane.
    ratio : float
        Strength over the vorticity's of further divergence, as where splines cannot follow a core.
    mesh : Mesh
        Half as far apart as the knots.
    area : float
        Of a cell of the mesh, px^2.
    width : float
        Over which the strength may vary, px.
    trend : (float, float), optional
        ln of the divergence's strength a round before, and of the ratio found for it.
    """

    strength: torch.Tensor
    divergence: float
    ratio: float
    mesh: Mesh
    area: float
    width: float
    trend: tuple[float, float] | None = None

    def band(self, knots: FlowSpline) -> torch.Tensor:
        """The prior's quadratic form; rigid motion and what else it leaves free is just not inf."""
        band = self.strength.new_zeros(2, 2, 7, knots.z.knots, 4, knots.y.knots)
        for terms, strength in ((_VORTICITY, self.strength), (_DIVERGENCE, self._divergent())):
            for a, first, sign in terms:
                for b, second, other in terms:
                    form = knots.form(self.area * strength, self.mesh, first, second)
                    band[a, b] += sign * other * form
        for a in (0, 1):
            band[a, a, 3, :, 0] += _RIDGE
        return band

    def _divergent(self) -> torch.Tensor:
        """Strength of all divergence: its variances add."""
        return 1 / (1 / self.divergence + 1 / (self.ratio * self.strength))

    def improved(self, knots: FlowSpline, coefficients: torch.Tensor, root: Factor) -> "Prior":
        """The prior nearer to the one of largest evidence (MacKay's fixed point).

        There the flow's energy is what the prior expects less what the images leave open.
        """
        found = knots.covariance(root)
        before = knots.covariance(knots.factor(self.band(knots)))
        told, energy = [], []
        for terms in (_VORTICITY, _DIVERGENCE):
            value = sum(
                sign * knots.field(coefficients, self.mesh, order)[a] for a, order, sign in terms
            )
            energy.append(value.square())
            told.append(
                sum(
                    sign
                    * other
                    * knots.spread(before[a, b] - found[a, b], self.mesh, first, second)
                    for a, first, sign in terms
                    for b, second, other in terms
                )
            )
        local = (self.smooth(self.strength * part) for part in (told[0], energy[0]))
        strength = self._divergent()
        share = strength / self.divergence
        everywhere, beside = (
            float(_bounded(*((part * strength * f[1]).mean() for f in (told, energy)), most))
            for part, most in ((share, _LARGEST_DIVERGENCE), (1 - share, _LARGEST))
        )
        everywhere = math.log(everywhere)
        most = _MOST_RATIO / float((1 / self.strength).mean())
        return self._replace(
            strength=self.strength * _bounded(*local, _LARGEST),
            divergence=min(self.divergence * math.exp(self._step(everywhere)), most),
            ratio=self.ratio * beside,
            trend=(math.log(self.divergence), everywhere),
        )

    def _step(self, ratio: float) -> float:
        """Change of ln divergence that takes ln of the ratio to 0, by the secant of two rounds.

        Where the images tell little, the fixed point alone would take hundreds of rounds.
        """
        slope = -1.0
        if self.trend is not None:
            x, y = self.trend
            run = math.log(self.divergence) - x
            slope = min(max((ratio - y) / run, -1.0), -0.15) if run else -1.0
        limit = math.log(_LARGEST_DIVERGENCE)
        return min(max(-ratio / slope, -limit), limit)

    def smooth(self, values: torch.Tensor) -> torch.Tensor:
        for axis, place in enumerate(self.mesh.places):
            kernel = torch.exp(-((place[:, None] - place) / self.width).square() / 2)
            kernel = kernel / kernel.sum(1, keepdim=True)
            values = kernel @ values if axis == 0 else values @ kernel.T
        return values


def _bounded(told: torch.Tensor, energy: torch.Tensor, most: float) -> torch.Tensor:
    """Ratio of the two, at most this factor from 1: far from the fixed point it may be 0."""
    return (told.clamp(min=0) / energy.clamp(min=1e-30)).clamp(1 / most, most)


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
) -> Displacement:
    """Displacement of every window's centre in the most probable flow between the images.

    Least is, over the flow u (displacement in dt) as B-splines,

        sum_k sum_x (I_k(x + path(u, t_k)) - mean_k)^2 / (2 s^2)
            + 1/2 integral L(x) vorticity^2 + divergence^2 / (1 / D + 1 / (q L(x))),

    with the images band-limited (`warping.band_limited`) and carried to mid-time along the curved
    paths of the flow, so that no texture has to be known; residuals beyond 3 s count linearly.
    The prior's strength L(x), which may vary over half a template, D and q are those of
    largest evidence: the energy of vorticity and of divergence is as large as the prior
    expects, of what the images tell (MacKay 1992, Neural Comput. 4, 415-447). So the flow is smoothed
    little in cores and strongly around them. Solved by Gauss-Newton steps from a coarse
    correlation, first on knots 1.25 templates apart, then 0.5.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
        On one device, where the result stays too. Brightness may differ by a factor and an offset,
        which are found anew for every flow, from the air that all images see.
    template, search, stride : int
        Pixels, see `windows.Windows`: where vectors are wanted, and the range of the first
        correlation (see `multipass`); the template also sets the scale of the knots.
    more : sequence of torch.Tensor
        Further images, each dt after the one before. Mid-time is then that of the whole burst.
    min_correlation : float
        Vectors are flagged where the images carried to mid-time correlate over a template by less
        than half way from this to 1: a flow that bends makes unrelated textures alike to 0.7.
    noise : float or torch.Tensor, optional
        Standard deviation of the images' white noise, of each pixel or of all; left out: from the
        images' spectra. Where images carried by the flow differ by more, that is taken.
    blur : float
        Standard deviation, px, of a Gaussian that the instrument blurred the images by. They are
        then sharpened before they are carried, as far as noise allows: shear turns what blur has
        done in cores, which is an error of a quarter there for a blur of 1 px.

    Returns
    -------
    Displacement
        Wind times dt at the windows' centres at mid-time. `score` is the smallest correlation of
        an image with the mean of the others, `covariance` that of the posterior: what the noise, and
        what else the images do not share, leaves open and the prior does not know. What splines
        cannot follow shows in neither: 0.02 px in vortex cores without noise. Where pixels are too
        coarse displacements are off by a fraction of a pixel that neighbours share: up to 0.04 px
        on particles of 2 px (1/e^2), 0.01 px of 2.5 px, nothing on larger ones.

    Raises
    ------
    InputError
        Sizes, threshold or noise out of range; images that differ in size.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    stack = [image1, image2, *more]
    for other in stack[1:]:
        image_pair(image1, other)
    windows = Windows(tuple(image1.shape), template, search, stride)
    images = _prepared(stack, noise, blur)
    shape, like = windows.shape, images.spline.coefficients[:0]
    grid = Grid(shape, 0.0, like)
    flow, _ = first_pass(image1, image2, windows, grid)
    pixels = tuple(torch.arange(n, dtype=like.dtype, device=like.device) for n in shape)
    prior = None
    for fine, (spacing, rounds) in enumerate((_COARSE, _FINE)):
        knots = FlowSpline(*(Axis(n, max(2.0, spacing * template)) for n in shape))
        mesh = knots.mesh(*pixels)
        coefficients = _fitted(flow, mesh)
        prior = _prior_on(knots, coefficients, prior, _WIDTH * template, like)
        for turn in range(rounds):
            seen = _linear(images, knots, mesh, coefficients)
            if fine and turn == _WEIGHED:
                images = _weighed(images, seen, _MISFIT_WIDTH * template)
                seen = _linear(images, knots, mesh, coefficients)
            root, coefficients = _step(seen, knots, mesh, coefficients, prior)
            # the first flow on coarse knots is nothing to learn from
            if turn or fine:
                prior = prior.improved(knots, coefficients, root)
        flow = knots.field(coefficients, mesh)
    seen = _linear(images, knots, mesh, coefficients)
    root, coefficients = _step(seen, knots, mesh, coefficients, prior)
    return _finished(stack, seen, knots, coefficients, root, prior, windows, min_correlation)


def _prepared(
    stack: Sequence[torch.Tensor], noise: float | torch.Tensor | None, blur: float
) -> Images:
    usable = torch.stack([torch.isfinite(image) for image in stack])
    trust = torch.ones_like(working(stack[0]))
    if isinstance(noise, torch.Tensor) and noise.ndim:
        known = torch.isfinite(noise)
        usable = usable & known
        # a level that few photons tell is lowest where an image is too dark by chance
        square = averaged(working(noise).nan_to_num(0.0).square(), known, _NOISE_WIDTH)
        trust = torch.where(square > 0, rms(noise) ** 2 / square, trust)
        # no pixel may outweigh a window of others
        trust = trust.clamp(max=100.0)
    images = levelled(stack)
    spline, level = band_limited(
        images, noise if noise is None else rms(noise), weight=trust.sqrt(), blur=blur
    )
    wide = max_pool2d((~usable).to(trust)[:, None], 7, stride=1, padding=3)[:, 0]
    time = torch.arange(len(stack), dtype=trust.dtype, device=trust.device)
    time = time - time.mean()
    return Images(spline, wide == 0, time, level, trust, images, blur)


def _weighed(images: Images, seen: Linear, width: float) -> Images:
    """The images with noise as large, at each place and wave, as what they do not share.

    Where no flow of the splines explains the images there is more than their noise: structure
    that moved through the plane or that is lost between pixels, motion on too small scales. What
    is known of the noise is the least.
    """
    rest = (seen.carried - seen.carried.mean(0)) * seen.seen
    free = (len(rest) - 1) * max(images.spline.passed, 1e-6)
    # what counts is the misfit where slopes are steep, and there it is largest (White 1980,
    # Econometrica 48, 817-838)
    steep = seen.slope.square().sum(0)
    steep = steep + 1e-3 * steep.mean() + 1e-30
    local = averaged(rest.square().sum(0) * images.trust * steep / free, seen.seen, width)
    local = local / averaged(steep, seen.seen, width)
    mean = float(local[seen.seen].mean()) if seen.seen.any() else 0.0
    level = max(images.noise**2, mean, 1e-30)
    local = local.clamp(min=max(images.noise**2, 0.5 * level))
    trust = images.trust * (level / local)
    share = mismatch(images.spline, rest * trust.sqrt()).clamp(
        min=max(images.noise**2, 0.5 * level)
    )
    spline, noise = band_limited(images.stack, level**0.5, share, trust.sqrt(), images.blur)
    return images._replace(spline=spline, noise=noise, trust=trust, weighed=True)


def _fitted(flow: torch.Tensor, mesh: Mesh) -> torch.Tensor:
    """Coefficients of the splines nearest to a flow (2, z, y) on the pixels."""
    for axis, swapped in ((0, False), (1, True)):
        basis = mesh.basis(axis)
        square = basis.T @ basis
        square += 1e-6 * torch.eye(len(square), dtype=square.dtype, device=square.device)
        solver = torch.linalg.solve(square, basis.T)
        flow = flow @ solver.T if swapped else solver @ flow
    return flow


def path(knots: FlowSpline, mesh: Mesh, coefficients: torch.Tensor, time: torch.Tensor):
    """Where air that is at the pixels at mid-time is at other times, (2, images, z, y), px.

    Lie series x + sum t^k / k! (u . grad)^(k - 1) u for a wind that stands still, up to t^6: where
    air turns by an angle a in t, the place is off by a^7 / 5040 of the radius.
    """
    flow = knots.field(coefficients, mesh)
    term = flow
    change = time[:, None, None] * term[:, None]
    for k in range(2, _PATH_ORDER + 1):
        if k == 2:
            along = [knots.field(coefficients, mesh, order) for order in ((1, 0), (0, 1))]
        else:
            along = torch.gradient(term, dim=(1, 2))
        term = flow[0] * along[0] + flow[1] * along[1]
        change = change + (time**k / math.factorial(k))[:, None, None] * term[:, None]
    z, y = mesh.places
    return torch.stack([change[0] + z[:, None], change[1] + y])


def _linear(images: Images, knots: FlowSpline, mesh: Mesh, coefficients: torch.Tensor) -> Linear:
    z, y = path(knots, mesh, coefficients, images.time)
    value, slope_z, slope_y = images.spline.sample(z, y)
    at = [p.round().long().clamp(0, n - 1) for p, n in zip((z, y), images.spline.shape)]
    number = torch.arange(len(value), device=value.device)[:, None, None]
    usable = images.usable[number, at[0], at[1]] & images.spline.holds(z, y)
    seen = usable.all(0)
    value, gain = _of_one_brightness(value, images.trust * seen)
    slope = torch.stack([(gain * slope_z).mean(0), (gain * slope_y).mean(0)])
    rest = (value - value.mean(0)) * images.trust.sqrt()
    free = (len(value) - 1) * max(images.spline.passed, 1e-6)
    misfit = rest.square().sum(0)
    # what no flow explains counts as noise: images are never taken to be better than they fit
    level = misfit_variance(misfit[seen], len(value))
    variance = max(images.noise**2, 1e-30)
    if not images.weighed:
        variance = max(variance, level / max(images.spline.passed, 1e-6))
    off = (misfit / (free * variance)).sqrt()
    trust = images.trust * (_ROBUST / off.clamp(min=_ROBUST)) * seen
    time = images.time[:, None, None]
    pull = -(time * (value - value.mean(0))).sum(0) * slope
    told = images.spline.worth * trust / variance
    weight = images.time.square().sum() * told / images.spline.excess
    return Linear(slope, told * pull, weight, variance, value, seen)


def _of_one_brightness(
    value: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Carried images with one mean and contrast, and what each was multiplied by.

    Of air that all images see, weighted as its noise deserves: bright air that enters a picture
    changes its mean by little, but by more than the noise of dark air.
    """
    share = weight / weight.sum().clamp(min=1e-30)
    value = value - (share * value).sum((1, 2), keepdim=True)
    contrast = (share * value.square()).sum((1, 2), keepdim=True).sqrt()
    # images come with nearly one contrast: what asks for more has none
    gain = (contrast[:1] / contrast).nan_to_num(1.0).clamp(0.5, 2.0)
    return gain * value, gain


def _step(
    seen: Linear, knots: FlowSpline, mesh: Mesh, coefficients: torch.Tensor, prior: "Prior"
) -> tuple[Factor, torch.Tensor]:
    """One Gauss-Newton step: the factor of the second derivative and the new coefficients."""
    slope = seen.slope
    data = knots.form(seen.weight * slope[:, None] * slope, mesh)
    band = prior.band(knots)
    gradient = knots.pulled(seen.pull, mesh) - knots.apply(band, coefficients)
    root = knots.factor(data + band)
    return root, coefficients + knots.solve(root, gradient)


def _prior_on(
    knots: FlowSpline,
    coefficients: torch.Tensor,
    before: Prior | None,
    width: float,
    like: torch.Tensor,
) -> Prior:
    """The prior found on coarser knots, or at first one as strong everywhere as the flow says."""
    places, area = [], 1.0
    for axis in (knots.z, knots.y):
        step = (axis.size - 1) / (2 * axis.cells)
        number = torch.arange(2 * axis.cells, dtype=like.dtype, device=like.device)
        places.append((number + 0.5) * step)
        area *= step
    mesh = knots.mesh(*places)
    if before is None:
        vorticity = sum(
            sign * knots.field(coefficients, mesh, order)[a] for a, order, sign in _VORTICITY
        )
        cells = knots.z.cells * knots.y.cells / (knots.z.size * knots.y.size)
        strength = cells / float(vorticity.square().mean() + 1e-6)
        start = torch.full(mesh.shape, strength).to(like)
        return Prior(start, _RATIO * strength, _RATIO, mesh, area, width)
    strength = before.strength.log()
    for axis in (0, 1):
        place, known = mesh.places[axis], before.mesh.places[axis]
        at = ((place - known[0]) / (known[1] - known[0])).clamp(0, len(known) - 1)
        low = at.floor().long().clamp(max=len(known) - 2)
        part = (at - low)[:, None] if axis == 0 else at - low
        strength = torch.lerp(
            strength.index_select(axis, low), strength.index_select(axis, low + 1), part
        )
    return Prior(strength.exp(), before.divergence, before.ratio, mesh, area, width)


def _finished(
    stack: Sequence[torch.Tensor],
    seen: Linear,
    knots: FlowSpline,
    coefficients: torch.Tensor,
    root: Factor,
    prior: Prior,
    windows: Windows,
    min_correlation: float,
) -> Displacement:
    like = coefficients
    centres = [
        torch.as_tensor(windows.starts(axis), device=like.device).to(like)
        + (windows.template - 1) / 2
        for axis in (0, 1)
    ]
    mesh = knots.mesh(*centres)
    d = knots.field(coefficients, mesh)
    spread = knots.spread(knots.covariance(root), mesh)
    prior_spread = knots.spread(knots.covariance(knots.factor(prior.band(knots))), mesh)
    covariance = torch.stack([spread[0, 0], spread[1, 1], spread[0, 1]])
    # what is left of the prior's variance: in the worse direction, and in both
    known = (prior_spread[0, 0] + prior_spread[1, 1]) / 2
    middle = (spread[0, 0] + spread[1, 1]) / 2
    worst = middle + torch.hypot((spread[0, 0] - spread[1, 1]) / 2, spread[0, 1])
    score = _agreement(seen, windows)
    matched = (middle < known / 2) & score.isfinite()
    bad = torch.stack([non_finite(stack[0], image, windows) for image in stack[1:]]).any(0)
    d = torch.where(matched, d, torch.nan)
    flag = (
        Flag.NO_MATCH * ~matched
        + Flag.LOW_TEXTURE * ((worst > known / 2) | ~matched)
        + Flag.LOW_CORRELATION * (matched & (score < (1 + min_correlation) / 2))
    ).to(torch.uint8)
    flag[bad] |= Flag.NON_FINITE_INPUT.value
    return Displacement(d[0], d[1], score.nan_to_num(0.0), flag, covariance)


def _agreement(seen: Linear, windows: Windows) -> torch.Tensor:
    """Smallest correlation, over a template, of an image carried to mid-time with the others' mean."""
    number = len(seen.carried)
    box = [torch.ones(windows.template, dtype=seen.slope.dtype, device=seen.slope.device)]
    scores = []
    for image in seen.carried:
        others = (seen.carried.sum(0) - image) / (number - 1)
        sums = torch.stack(
            [torch.ones_like(image), image, others, image**2, others**2, image * others]
        )
        sums = sums * seen.seen
        for axis in (1, 2):
            sums = sums.narrow(axis, windows.lead, sums.shape[axis] - windows.lead)
            sums = window_sums(sums, box, windows.stride, axis)[0]
            sums = sums.narrow(axis, 0, windows.count[axis - 1])
        first, second, square1, square2, cross = sums[1:] / sums[0].clamp(min=1)
        contrast = (square1 - first**2).clamp(min=0) * (square2 - second**2).clamp(min=0)
        scores.append((cross - first * second) / contrast.sqrt())
    return torch.stack(scores).amin(0)
