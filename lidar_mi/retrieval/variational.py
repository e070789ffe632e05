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

from lidar_mi.retrieval.block_tridiagonal import Factor
from lidar_mi.retrieval.displacement import Displacement
from lidar_mi.retrieval.flow_spline import Axis, FlowSpline, Mesh
from lidar_mi.retrieval.multipass import Grid, first_pass, window_sums
from lidar_mi.retrieval.quality import Flag, check_between, non_finite
from lidar_mi.retrieval.warping import Spline, band_limited, levelled, rms
from lidar_mi.retrieval.windows import Windows, image_pair, working

# Rounds of flow and evidence on coarse and on fine knots, whose spacing is this over the template.
_COARSE, _FINE = (1.25, 8), (0.625, 5)
# Divergence is first taken to have a tenth of the vorticity's standard deviation.
_RATIO = 100.0
# Width over which the prior's strength varies, over the template.
_WIDTH = 0.5
# Residuals beyond so many standard deviations pull no harder than these.
_ROBUST = 3.0
# Precision of each coefficient beside the prior's, px^-2: nothing for a displacement of some px.
_RIDGE = 1e-4
# Factor by which the prior may change in a round.
_LARGEST = 4.0
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
    """

    spline: Spline
    usable: torch.Tensor
    time: torch.Tensor
    noise: float
    trust: torch.Tensor


class Linear(NamedTuple):
    """The images about a flow: what they say on its change.

    `slope` (2, z, y) of the mean of the images carried to mid-time, `pull` the slope's weight in
    the gradient, `weight` that of the slopes' products in the second derivative, `variance` of a
    difference from the mean, `carried` the images at mid-time and `seen` where all of them are.
    """

    slope: torch.Tensor
    pull: torch.Tensor
    weight: torch.Tensor
    variance: float
    carried: torch.Tensor
    seen: torch.Tensor


class Prior(NamedTuple):
    """Vorticity and divergence are white noise of variance 1 / strength and 1 / (ratio strength).

    Attributes
    ----------
    strength : torch.Tensor
        On the mesh.
    ratio : float
    mesh : Mesh
        Half as far apart as the knots.
    area : float
        Of a cell of the mesh, px^2.
    width : float
        Over which the strength may vary, px.
    """

    strength: torch.Tensor
    ratio: float
    mesh: Mesh
    area: float
    width: float

    def band(self, knots: FlowSpline) -> torch.Tensor:
        """The prior's quadratic form; rigid motion and what else it leaves free is just not inf."""
        weight = self.area * self.strength
        band = weight.new_zeros(2, 2, 7, knots.z.knots, 4, knots.y.knots)
        for terms, factor in ((_VORTICITY, 1.0), (_DIVERGENCE, self.ratio)):
            for a, first, sign in terms:
                for b, second, other in terms:
                    form = knots.form(weight, self.mesh, first, second)
                    band[a, b] += factor * sign * other * form
        for a in (0, 1):
            band[a, a, 3, :, 0] += _RIDGE
        return band

    def improved(self, knots: FlowSpline, coefficients: torch.Tensor, root: Factor) -> "Prior":
        """The prior nearer to the one of largest evidence (MacKay's fixed point).

        There the flow's energy is what the prior expects less what the images leave open.
        """
        found = knots.covariance(root)
        before = knots.covariance(knots.factor(self.band(knots)))
        weight = self.area * self.strength
        energies = []
        for terms in (_VORTICITY, _DIVERGENCE):
            value = sum(
                sign * knots.field(coefficients, self.mesh, order)[a] for a, order, sign in terms
            )
            spread = [
                sum(
                    sign * other * knots.spread(band[a, b], self.mesh, first, second)
                    for a, first, sign in terms
                    for b, second, other in terms
                )
                for band in (before, found)
            ]
            energies.append((weight * (spread[0] - spread[1]), weight * value.square()))
        return self._replace(
            strength=self.strength * _bounded(*(self.smooth(part) for part in energies[0])),
            ratio=self.ratio * float(_bounded(*(part.sum() for part in energies[1]))),
        )

    def smooth(self, values: torch.Tensor) -> torch.Tensor:
        for axis, place in enumerate(self.mesh.places):
            kernel = torch.exp(-((place[:, None] - place) / self.width).square() / 2)
            kernel = kernel / kernel.sum(1, keepdim=True)
            values = kernel @ values if axis == 0 else values @ kernel.T
        return values


def _bounded(told: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    """Ratio of the two, at most a factor of _LARGEST from 1: far from the fixed point it may be 0."""
    return (told.clamp(min=0) / energy.clamp(min=1e-30)).clamp(1 / _LARGEST, _LARGEST)


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
) -> Displacement:
    """Displacement of every window's centre in the most probable flow between the images.

    Least is, over the flow u (displacement in dt) as B-splines,

        sum_k sum_x (I_k(x + path(u, t_k)) - mean_k)^2 / (2 s^2)
            + 1/2 integral L(x) (vorticity^2 + q divergence^2),

    with the images band-limited (`warping.band_limited`) and carried to mid-time along the curved
    paths of the flow, so that no texture has to be known; residuals beyond 3 s count linearly.
    The prior's strength L(x), which may vary over half a template, and the ratio q are those of
    largest evidence: the energy of vorticity and of divergence is as large as the prior
    expects, of what the images tell (MacKay 1992, Neural Comput. 4, 415-447). So the flow is smoothed
    little in cores and strongly around them. Solved by Gauss-Newton steps from a coarse
    correlation, first on knots 1.25 templates apart, then 0.625.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
        On one device, where the result stays too. Brightness may differ by a factor and an offset.
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
        images' spectra.

    Returns
    -------
    Displacement
        Wind times dt at the windows' centres at mid-time. `score` is the smallest correlation of
        an image with the mean of the others, `covariance` that of the posterior: what the noise leaves
        open and the prior does not know.

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
    images = _prepared(stack, noise)
    shape, like = windows.shape, images.spline.coefficients[:0]
    grid = Grid(shape, 0.0, like)
    flow, _ = first_pass(image1, image2, windows, grid)
    pixels = tuple(torch.arange(n, dtype=like.dtype, device=like.device) for n in shape)
    prior = None
    for spacing, rounds in (_COARSE, _FINE):
        knots = FlowSpline(*(Axis(n, max(2.0, spacing * template)) for n in shape))
        mesh = knots.mesh(*pixels)
        coefficients = _fitted(flow, mesh)
        prior = _prior_on(knots, coefficients, prior, _WIDTH * template, like)
        for turn in range(rounds):
            seen = _linear(images, knots, mesh, coefficients)
            root, coefficients = _step(seen, knots, mesh, coefficients, prior)
            if turn:
                prior = prior.improved(knots, coefficients, root)
        flow = knots.field(coefficients, mesh)
    seen = _linear(images, knots, mesh, coefficients)
    root, coefficients = _step(seen, knots, mesh, coefficients, prior)
    return _finished(stack, seen, knots, coefficients, root, prior, windows, min_correlation)


def _prepared(stack: Sequence[torch.Tensor], noise: float | torch.Tensor | None) -> Images:
    usable = torch.stack([torch.isfinite(image) for image in stack])
    trust = torch.ones_like(working(stack[0]))
    if isinstance(noise, torch.Tensor) and noise.ndim:
        square = working(noise).square()
        mean = rms(noise) ** 2
        usable = usable & torch.isfinite(noise)
        trust = torch.where((square > 0) & torch.isfinite(noise), mean / square, trust)
        # no pixel may outweigh a window of others
        trust = trust.clamp(max=100.0)
    spline, level = band_limited(levelled(stack), noise if noise is None else rms(noise))
    wide = max_pool2d((~usable).to(trust)[:, None], 7, stride=1, padding=3)[:, 0]
    time = torch.arange(len(stack), dtype=trust.dtype, device=trust.device)
    return Images(spline, wide == 0, time - time.mean(), level, trust)


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


def _linear(
    images: Images, knots: FlowSpline, mesh: Mesh, coefficients: torch.Tensor
) -> Linear:
    z, y = path(knots, mesh, coefficients, images.time)
    value, slope_z, slope_y = images.spline.sample(z, y)
    at = [p.round().long().clamp(0, n - 1) for p, n in zip((z, y), images.spline.shape)]
    number = torch.arange(len(value), device=value.device)[:, None, None]
    usable = images.usable[number, at[0], at[1]] & images.spline.holds(z, y)
    seen = usable.all(0)
    slope = torch.stack([slope_z.mean(0), slope_y.mean(0)])
    rest = (value - value.mean(0)) * images.trust.sqrt()
    free = (len(value) - 1) * max(images.spline.passed, 1e-6)
    misfit = rest.square().sum(0)
    # what no flow explains counts as noise: images are never taken to be better than they fit
    level = misfit[seen].median() / _MEDIAN[min(len(value), len(_MEDIAN) - 1)] if seen.any() else 0.0
    variance = max(images.noise**2, float(level) / max(images.spline.passed, 1e-6), 1e-30)
    off = (misfit / (free * variance)).sqrt()
    trust = images.trust * (_ROBUST / off.clamp(min=_ROBUST)) * seen
    pull = -(images.time[:, None, None] * (value - value.mean(0))).sum(0) * trust / variance
    weight = images.time.square().sum() * trust / (variance * images.spline.excess)
    return Linear(slope, pull, weight, variance, value, seen)


# Median of chi-square with n - 1 degrees of freedom, by the number n of images.
_MEDIAN = (1.0, 1.0, 0.4549, 1.3863, 2.3660, 3.3567, 4.3515, 5.3481)


def _step(
    seen: Linear, knots: FlowSpline, mesh: Mesh, coefficients: torch.Tensor, prior: "Prior"
) -> tuple[Factor, torch.Tensor]:
    """One Gauss-Newton step: the factor of the second derivative and the new coefficients."""
    slope = seen.slope
    data = knots.form(seen.weight * slope[:, None] * slope, mesh)
    band = prior.band(knots)
    gradient = knots.pulled(seen.pull * slope, mesh) - knots.apply(band, coefficients)
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
        return Prior(torch.full(mesh.shape, strength).to(like), _RATIO, mesh, area, width)
    strength = before.strength.log()
    for axis in (0, 1):
        place, known = mesh.places[axis], before.mesh.places[axis]
        at = ((place - known[0]) / (known[1] - known[0])).clamp(0, len(known) - 1)
        low = at.floor().long().clamp(max=len(known) - 2)
        part = (at - low)[:, None] if axis == 0 else at - low
        strength = torch.lerp(
            strength.index_select(axis, low), strength.index_select(axis, low + 1), part
        )
    return Prior(strength.exp(), before.ratio, mesh, area, width)


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
