"""What makes warped images differ: variance components, by restricted maximum likelihood.

To first order about a flow the difference of two warped images is

    D = -J (u + u_f) + e + r + m,

with the slopes J, the error u of the flow, the motion u_f that its splines do not resolve, white
noise e, texture r that is replaced and structure m that moves through the plane. Each is a
zero-mean Gaussian field: its covariance is known but for one amplitude.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import combinations_with_replacement, pairwise

import numpy as np
import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import Images, Linear
from lidar_mi.retrieval.flow.posterior import Response
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.images.band_limit import (
    even_fast_len,
    flat_if_better,
    radii,
    shell_means,
    wavenumbers,
)
from lidar_mi.retrieval.images.spline import Spline, filter_of, finite, spectrum_of, transform_sizes
from lidar_mi.retrieval.images.windows import averaged, separable, working
from lidar_mi.retrieval.likelihood.reml import most_likely
from lidar_mi.retrieval.symmetric import eigenvalues

_DRAWS = {2: 4, 3: 2}
"""Random fields of each component, by dimensions: a mean square over all places is known to 2 %."""
_SCALES = (1.5, 3.0)
"""Standard deviations, px, of the Gaussian means between which squares are told apart by scale."""
_REGION = 8
"""Standard deviation of the Gaussian mean of the squares, and the separation of its places, px."""
_TAPER = 4.0
"""Standard deviation, px, of the Gaussian by which spectra fade next to invalid pixels."""
_STORED = 1 << 21
"""Random numbers of a field that is stored for the next time: to draw them takes as long as the
transforms of a small image."""
_RATIO_OF_TWO = (2 - 3**0.5) ** 2
"""Median ratio of the eigenvalues of the structure tensor of two independent slopes."""
_LEAST_DENSITY = 1e-6
"""Of the differences, over their mean: what is less is rounding."""
_MOST = 1e60
"""Of an amplitude, whose root is a number in single precision."""
_LEAST_MOTION = 0.015
"""px: differences that are finer than those of this motion are of interpolation and ringing."""


@dataclass(frozen=True)
class Differences:
    """The model of the differences of images, with its amplitudes.

    images: with the filter and the weights by which the noise is white.
    unresolved (...): variance of a component of the motion that the splines do not resolve, px^2.
    amplitudes: variance of each component over that of its unit: of the noise per squared
        intensity, 2 (1 - c) / c of a fraction 1 - c^2 of the texture that is replaced, px^2 of
        motion through the plane, fraction of the variance that the prior's spectrum has beyond the
        splines.
    """

    images: Images
    unresolved: torch.Tensor
    amplitudes: Mapping[str, float]


def differences(
    images: Images,
    linear: Linear,
    mesh: Mesh,
    coefficients: torch.Tensor,
    prior: Prior,
    template: int,
    response: Response | None,
) -> Differences:
    """The components of the differences about a fitted flow, estimated by REML.

    The residuals of a fit are r = R D of the differences, with R = I - J C J^T W and the posterior
    covariance C.
    Random fields of every component are sent through R. So are flows drawn from the prior, of
    which R J C (P u) is left with the prior's precision P. Squares of the residuals, by three
    scales and by place, have gamma distributions whose means are sums of those of the components.
    The amplitudes are the likeliest (`reml.most_likely`): what the fit absorbs is counted, as in
    restricted maximum likelihood (Patterson & Thompson 1971, Biometrika 58, 545-554). That of the
    unresolved motion is 1 where the prior's spectrum goes on beyond the splines, and at most.

    What differs from the sum of the components by place, and by wavenumber, multiplies it: the
    variance of the ratio, less that of its sampling, says how freely (`_shrunk`).

    linear: of the images, about the flow.
    mesh: of the pixels.
    coefficients: of the flow.
    template: px; half of it is the width over which amplitudes vary with the images.
    response: see `Response`. Without it nothing counts as absorbed: in volumes it is 2 to 10 %.
    """
    valid, spline = linear.valid, images.spline
    width = 0.5 * template
    times = float(images.time.square().sum())
    time = images.time.to(linear.warped).reshape(-1, *[1] * mesh.dims)
    difference = (time * linear.warped).sum(0) / times * valid
    # outliers, which count little in the fit, are none of the components
    regular = difference * linear.regular
    unresolved = _variance_beyond(prior, mesh)
    squares = _Squares(valid)
    observed = squares(regular[None])[0]
    use = squares.inside & (observed > 0)
    if not bool(use.any()):
        return Differences(images, torch.zeros_like(unresolved), {})
    draws = _DRAWS[mesh.dims]
    kinds = _drawn(images, linear, mesh, unresolved, times, width)
    known_variance = images.known_noise**2
    absorb = _residual_operator(linear, mesh, response)
    # of all at once, which takes less time
    rests = dict(zip(kinds, absorb(torch.cat([*kinds.values()])).split(draws), strict=True))
    by_flows = _flows_left(linear, mesh, prior, response)
    of_flows = squares(by_flows).mean(0)
    drawn = {name: squares(fields) for name, fields in rests.items()}
    number = (1 / _chance(drawn["noise"])).expand_as(observed)
    terms = {name: fields.mean(0) for name, fields in drawn.items()}
    known = of_flows + known_variance * terms["noise"]

    # a noise that is known is not estimated
    names = [name for name in kinds if not (name == "noise" and images.noise_known)]
    fields = (observed, torch.stack([terms[name] for name in names]), number, known)
    square, means, half, rest = (field[..., use].cpu().numpy() for field in fields)
    most = np.array([1.0 if name == "unresolved" else np.inf for name in names])
    _, factors = most_likely(square, means, most, half, rest)
    # that of fields that are zero may be any number, of which single precision has no root
    factors = factors.clip(0.0, _MOST)
    amplitudes = {name: float(a) for name, a in zip(names, factors, strict=True)}
    amplitudes["noise"] = amplitudes.get("noise", 0.0) + known_variance

    def total(parts: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return reduce(torch.add, (amplitudes[name] ** 0.5 * parts[name] for name in parts))

    noise, after = total(kinds), total(rests) + by_flows
    expected = squares(after).mean(0).clamp(min=1e-30)
    # noise counts in the scales of the texture, which inform the flow
    weight = (terms["replaced"] / expected).where(use, 0.0)
    weight = weight / weight.sum(0).clamp(min=1e-30)
    ratio = (weight * observed / expected).sum(0)
    count = 1 / (weight.square() / number).sum(0).clamp(min=1e-30)
    local = squares.on_pixels(_shrunk(ratio, count, weight.sum(0) > 0.5))
    steep = float(linear.slope.square().sum(0)[valid].mean()) / mesh.dims
    floor = _LEAST_MOTION**2 * steep
    level = (
        times / max(spline.passed, 1e-6) * local * averaged(noise.square().mean(0), valid, width)
    )
    if mesh.dims == 2:
        # a noise that is known is there, however little the fit leaves
        level = level.maximum(known_variance / working(images.given_weight))
    level = level.clamp(min=max(floor, 1e-30))
    mean = float(level[valid].mean())
    weight = (mean / level).to(images.weight)
    mismatch = None
    # in a thin volume few shells hold the texture, and edges make most of what is in them
    if mesh.dims == 2:
        whiten = (weight * times).sqrt().to(noise) * _tapered(valid)
        scaled = whiten * local.sqrt().to(noise)
        mismatch = working(
            _spectrum(spline, scaled * noise, scaled * after, whiten * difference)
        ).clamp(min=max(floor, _LEAST_DENSITY * mean))
        mismatch = flat_if_better(
            spectrum_of(images.stack, weight.sqrt(), spline.settings),
            mismatch,
            spline.settings.threshold,
            _mean_square_strain(mesh.slopes(coefficients)),
        )
    chosen = filter_of(
        images.stack, mean**0.5, mismatch, weight.sqrt(), images.blur, spline.settings
    )
    again = images.filtered(chosen)._replace(weight=weight, noise_updated=True)
    # where the residual is smaller than expected, so is the motion that would make it
    unresolved = unresolved * amplitudes["unresolved"] * local.clamp(max=1.0)
    return Differences(again, unresolved, amplitudes)


def _spectrum(
    spline: Spline, noise: torch.Tensor, expected: torch.Tensor, observed: torch.Tensor
) -> torch.Tensor:
    """Spectral density of the differences before the filter of a spline, (shells,).

    That of draws of the noise, times the ratio of the residual found to the expected ones.
    """
    sizes = transform_sizes(spline.shape, spline.settings)
    _, shell = radii(tuple(sizes), spline.shape, noise.dtype, noise.device)

    def density(fields: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return shell_means(fields, shell, sizes, spline.settings.smoothing)

    (of_noise, _), (of_rest, _), (of_found, uncertainty) = (
        density(part) for part in (noise, expected, observed[None])
    )
    ratio = of_found / of_rest.clamp(min=1e-30)
    colour = _shrunk(ratio, uncertainty**-2, torch.ones_like(ratio, dtype=torch.bool))
    return of_noise * colour / spline.gain.square().clamp(min=1e-6)


def _drawn(
    images: Images, linear: Linear, mesh: Mesh, unresolved: torch.Tensor, times: float, width: float
) -> dict[str, torch.Tensor]:
    """Random differences in dt of unit amplitude, (draws, ...), after the images' filter."""
    spline, valid = images.spline, linear.valid
    slope = linear.slope
    like, shape = slope, (_DRAWS[mesh.dims], *slope.shape[1:])
    steep = averaged(slope.square().sum(0), valid, width)
    # texture is stronger where slopes are
    local = (steep / steep[valid].mean().clamp(min=1e-30)).sqrt()

    def textured(density: torch.Tensor, seed: int) -> torch.Tensor:
        shaped = spline._replace(gain=spline.gain * density[: len(spline.gain)].sqrt())
        return local * shaped.filtered(normal_fields(shape, like, seed))

    texture = _texture_density(images, linear)
    wave = wavenumbers(texture, spline.shape)
    white = normal_fields(shape, like, 1) / images.given_weight.sqrt().to(like)
    finer = _motion_beyond(shape, mesh, like, 4) * unresolved.sqrt().to(like)
    kinds = {
        "noise": spline.filtered(white) / times**0.5,
        "replaced": textured(texture, 2),
        "unresolved": (slope * finer).sum(1),
    }
    if mesh.dims == 2:
        kinds["through the plane"] = textured(_density_of_displaced(wave, texture), 3)
    return kinds


def without_texture(images: Images, template: int) -> torch.Tensor:
    """Where images in a plane have less than two independent structures in a template.

    A displacement has two components, so that one structure does not tell it: its error is that of
    the flow's prior, which is then estimated from the error. Of n independent isotropic slopes
    the ratio t of the structure tensor's eigenvalues has the distribution of the two-dimensional
    Wishart matrix (Muirhead 1982, Aspects of Multivariate Statistical Theory, 3.2): of two slopes
    P(t) = 2 t^(1/2) / (1 + t), with the median (2 - 3^(1/2))^2. Counted are places where the ratio
    is below that in most of what stands out of noise within two templates, and all where that holds
    of most: what the flow is elsewhere depends on the prior.

    images: as prepared, with the noise as given or estimated. Not filtered: after the filter the
        least rounding may be as large as the texture.
    template: px, twice the standard deviation of the Gaussian mean of the tensor.
    """
    valid = images.usable.all(0)
    slopes = torch.gradient(finite(working(images.stack)), dim=(1, 2))
    # structure tensor, in the mean of the images
    zz, zy, yy = (
        averaged((one * other).mean(0), valid, 0.5 * template)
        for one, other in combinations_with_replacement(slopes, 2)
    )
    # slopes of white noise by central differences have half of its variance
    noisy = images.noise**2 / 2 / working(images.weight)
    weak, strong = (part - noisy for part in eigenvalues(zz, zy, yy))
    # where the slopes are of noise nothing is said, and next to none is none
    determined = strong > (2 * noisy).clamp(min=_LEAST_MOTION**2 * float(strong[valid].mean()))
    single = determined & (weak < _RATIO_OF_TWO * strong)
    share = [averaged(working(part), valid, 2 * template) for part in (single, determined)]
    untextured = share[0] > 0.5 * share[1]
    return untextured | (single[valid].sum() > 0.5 * determined[valid].sum())


def normal_fields(shape: Sequence[int], like: torch.Tensor, seed: int) -> torch.Tensor:
    """Independent standard normal numbers, the same on every device."""
    known = math.prod(shape) <= _STORED
    draw = _normal_fields if known else _normal_fields.__wrapped__
    return draw(tuple(shape), like.dtype, like.device, seed)


@lru_cache(maxsize=16)
def _normal_fields(
    shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, seed: int
) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=random, dtype=torch.float64).to(device, dtype)


def _texture_density(images: Images, linear: Linear) -> torch.Tensor:
    """Spectral density of the texture that the warped images have in common, (shells,).

    The real part of their cross-spectrum: noise and outliers of one image are not in it.
    """
    spline = images.spline
    sizes = transform_sizes(spline.shape, spline.settings)
    first, last = linear.warped[0], linear.warped[-1]
    _, shell = radii(tuple(sizes), spline.shape, first.dtype, first.device)
    both = torch.stack([(first + last) / 2, (first - last) / 2]) * _tapered(linear.valid)
    (mean, uncertainty), (half, _) = (
        shell_means(part[None], shell, sizes, spline.settings.smoothing) for part in both
    )
    common = mean - half
    # the means of shells of noise alone scatter about 0
    above = common > spline.settings.threshold * uncertainty * (mean + half) / 2**0.5
    return torch.where(above, common / spline.gain.square().clamp(min=1e-6), 0.0)


def _tapered(valid: torch.Tensor) -> torch.Tensor:
    """Weights of valid pixels for a spectrum, of mean square 1: smooth towards what is not valid.

    A step would spread the power of long waves over all others.
    """
    share = averaged(valid.float(), torch.ones_like(valid), _TAPER)
    weight = (2 * share - 1).clamp(min=0.0) * valid
    return weight / weight.square().mean().sqrt().clamp(min=1e-6)


def _density_of_displaced(wave: torch.Tensor, texture: torch.Tensor) -> torch.Tensor:
    """Spectral density of the differences made by 1 px of motion through the plane, (shells,).

    Texture changes by the displacement times its gradient across the plane. If it is isotropic in
    space, its spectral density T gives that of a slice, S(k) = integral T(|(k, q)|) dq, and that
    of the gradient, F(k) = integral q^2 T(|(k, q)|) dq, over the wavenumbers q across the plane.
    Then dF/dk = -k S, so that F(k) is the integral of k' S(k') from k on.
    """
    part = wave * texture * (wave[1] - wave[0])
    # of the shell about k itself half is beyond k
    return part.flip(0).cumsum(0).flip(0) - part / 2


def _unresolved_fraction(mesh: Mesh, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Wavenumbers, rad per px, and the fraction of a wave's variance that the splines leave.

    Of cubic splines of least squares it is 1 - s(0) / sum_n s(n), with s(n) the eighth power of
    sinc(f + n) at f waves per knot (Unser, Aldroubi & Eden 1993, IEEE Trans. Signal Process. 41,
    834-848).
    """
    axis = mesh.axes[0]
    knots = (axis.size - 1) / axis.cells
    lowest, highest = 0.1 * math.pi / max(knots, 1.0), math.pi
    wave = torch.exp(torch.linspace(math.log(lowest), math.log(highest), 24).to(like))
    per_knot = wave * knots / (2 * math.pi)
    power = torch.sinc(per_knot[:, None] + torch.arange(-8, 9).to(like)).pow(8)
    # of long waves next to none is left, which rounding may make negative
    return wave, (1 - torch.sinc(per_knot).pow(8) / power.sum(1)).clamp(min=0.0)


def _variance_beyond(prior: Prior, mesh: Mesh) -> torch.Tensor:
    """Variance of a component of the motion that the splines leave of the prior, px^2, (...)."""
    wave, fraction = _unresolved_fraction(mesh, prior.local)
    step = float((wave[1] / wave[0]).log())
    total = torch.zeros_like(prior.local[0])
    for k, part in zip(wave, fraction, strict=True):
        # waves in an octave, per radian^dims: k^2 / 2 pi of a plane, k^3 / 2 pi^2 of a volume
        waves = k**2 / (2 * math.pi) if mesh.dims == 2 else k**3 / (2 * math.pi**2)
        total += part * step * waves * prior.density(k)
    return interpolated(total, prior.mesh.places, [place.to(total) for place in mesh.places])


def _motion_beyond(shape: Sequence[int], mesh: Mesh, like: torch.Tensor, seed: int) -> torch.Tensor:
    """Random motion (draws, components, ...) of unit variance in waves that the splines leave."""
    draws, *sizes = shape
    whole = [even_fast_len(n) for n in sizes]
    dims = tuple(range(-len(sizes), 0))
    k = 2 * math.pi * radii(tuple(whole), tuple(sizes), like.dtype, like.device)[0]
    wave, fraction = _unresolved_fraction(mesh, like)
    # of the inertial range, whose spectrum falls by k^(-5/3)
    power = fraction * wave ** (-2 / 3 - mesh.dims)
    at = torch.searchsorted(wave, k.contiguous()).clamp(max=len(wave) - 1)
    gain = torch.where(k > 0, power[at], 0.0).sqrt()
    field = normal_fields((draws, mesh.dims, *whole), like, seed)
    field = torch.fft.irfftn(torch.fft.rfftn(field, dim=dims) * gain, s=whole, dim=dims)
    field = field[(..., *(slice(n) for n in sizes))]
    return field / field.square().mean().sqrt()


def _residual_operator(
    linear: Linear, mesh: Mesh, response: Response | None
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Residuals of a fit to differences (draws, ...), to first order."""
    slope, weight = linear.slope, linear.weight

    def left(differences: torch.Tensor) -> torch.Tensor:
        if response is None:
            return differences * linear.valid
        differences = differences.to(slope) * linear.valid
        changes = response(mesh.transposed(-differences[:, None] * (slope * weight)))
        return (differences + (slope * mesh.field(changes)).sum(1)) * linear.valid

    return left


def _flows_left(
    linear: Linear, mesh: Mesh, prior: Prior, response: Response | None
) -> torch.Tensor:
    """Residuals of a fit to the differences by flows drawn from the prior, (draws, ...)."""
    slope = linear.slope
    if response is None:
        return torch.zeros_like(slope[:1]).expand(_DRAWS[mesh.dims], *slope.shape[1:])
    weights = prior.weights
    drawn = weights.sqrt() * normal_fields((_DRAWS[mesh.dims], *weights.shape), weights, 5)
    flows = prior.rates_transposed(drawn).to(slope)
    return (slope * mesh.field(response(flows))).sum(1) * linear.valid


class _Squares:
    """Mean squares of fields (n, ...) by scale and place: (n, scales, places ...).

    Summed in single precision: they scatter by more than 1e-2.
    """

    def __init__(self, valid: torch.Tensor):
        like = torch.empty(0, dtype=torch.float32, device=valid.device)
        self.shape = valid.shape
        self._means = [[_gaussian(n, n, 1, width, like) for n in valid.shape] for width in _SCALES]
        self._region = [_gaussian(-(-n // _REGION), n, _REGION, _REGION, like) for n in valid.shape]
        self._valid = valid.to(like)
        self._share = separable(self._valid, self._region)
        self.inside = (self._share > 0.5).expand(len(_SCALES) + 1, *self._share.shape)

    def __call__(self, fields: torch.Tensor) -> torch.Tensor:
        fields = fields.to(self._valid) * self._valid
        means = [fields, *(separable(fields, mean) for mean in self._means)]
        bands = [*(a - b for a, b in pairwise(means)), means[-1]]
        square = torch.stack(bands, 1) * self._valid
        return working(separable(square.square(), self._region) / self._share.clamp(min=1e-3))

    def on_pixels(self, values: torch.Tensor) -> torch.Tensor:
        """Positive values at the places, at the pixels."""
        places = [torch.arange(0, n, _REGION).to(values) for n in self.shape]
        pixels = [torch.arange(n).to(values) for n in self.shape]
        return interpolated(values.log(), places, pixels).exp()


def _gaussian(
    places: int, pixels: int, separation: int, width: float, like: torch.Tensor
) -> torch.Tensor:
    """Weights (places, pixels) of a Gaussian mean about places; of sum 1 at the rim too."""
    at, of = torch.arange(places).to(like) * separation, torch.arange(pixels).to(like)
    kernel = torch.exp(-((at[:, None] - of) / width).square() / 2)
    return kernel / kernel.sum(1, keepdim=True)


def _chance(squares: torch.Tensor) -> torch.Tensor:
    """Variance of a mean square over its mean by scale, from the scatter of the draws."""
    ratio = squares / squares.mean(0).clamp(min=1e-30)
    dims = tuple(range(1, ratio.ndim - 1))
    variance = ratio.var(0).mean(dims, keepdim=True) * len(squares) / (len(squares) - 1)
    return variance.clamp(min=1e-6)


def _shrunk(ratio: torch.Tensor, number: torch.Tensor, use: torch.Tensor) -> torch.Tensor:
    """Ratios of squares to what is expected, with as much freedom as their scatter shows.

    A ratio of `number` independent squares scatters by 1 / number about its true value, and that
    scatters about 1 by what is left (moments; DerSimonian & Laird 1986, Control. Clin. Trials 7,
    177-188). Where not in `use` it is 1.
    """
    chance = 1 / number.clamp(min=1e-3)
    free = ((ratio[use] - 1).square().mean() - chance[use].mean()).clamp(min=1e-6)
    shrunk = (free * ratio + chance) / (free + chance)
    return torch.where(use, shrunk, 1.0).clamp(min=1e-6)


def _mean_square_strain(slopes: Sequence[torch.Tensor]) -> float:
    """Of a flow in a plane without its divergence, along any direction."""
    along_z, along_y = slopes
    stretched, sheared = along_z[0] - along_y[1], along_z[1] + along_y[0]
    return float((stretched.square() + sheared.square()).mean()) / 8
