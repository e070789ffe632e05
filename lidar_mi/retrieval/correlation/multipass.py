"""Multi-pass correlation: coarse to fine, both images or volumes deformed half way (multipass).

The first pass correlates windows twice as large. Every later pass deforms both images by half of
the displacement so far, in opposite directions, and fits an affine displacement to the remaining
difference in each window, weighted by a Gaussian. Between passes outliers of the median test are
replaced.
"""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import torch
from torch.nn.functional import pad

from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.first_pass import Grid, first_pass
from lidar_mi.retrieval.correlation.outliers import validated
from lidar_mi.retrieval.correlation.settings import VOLUME_MULTIPASS, MultipassSettings
from lidar_mi.retrieval.images import windows as geometry
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.intensity import normalised, normalised_intensity, rms
from lidar_mi.retrieval.images.quality import check_between, informative, non_finite
from lidar_mi.retrieval.images.spline import Spline, band_limited, nearest
from lidar_mi.retrieval.images.windows import Windows, averaged, image_pair, window_sums, working

# Variance by the displacement's curvature over that of the gradients' differences, which windows
# have smoothed, and the Gaussian mean of it, in vectors: the curvature changes its sign in cores.
# Normalised errors in volumes of the simulated wake then have variances of 1.0 to 1.8, and of 0.6
# to 0.9 in those of a pair with cores of 6 voxels.
_CURVATURE_FACTOR, _NEAR = 2.0, 1.0


def multipass(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    min_correlation: float = 0.5,
    noise: float | torch.Tensor | None = None,
    settings: MultipassSettings | None = None,
    partly: bool = False,
) -> Displacement:
    """Displacement of every window by correlation of images deformed to fit, coarse to fine.

    Window deformation after Scarano (2002, Meas. Sci. Technol. 13, R1-R19; in volumes Elsinga et
    al. 2006, Exp. Fluids 41, 933-947), symmetric in time. Where images are nearly aligned already,
    the shift of highest correlation is the least squares solution of the linearised difference of
    the images, which the later passes solve at once for displacement and displacement gradient
    (affine), both of the whole motion and not of the remainder: so noise in the predictor does not
    accumulate from pass to pass. Images are band-limited before (see `band_limit.best_filter`).
    Their brightness may differ by a factor and an offset.

    A Gaussian window with a standard deviation sigma of a third of the template weights the
    pixels; displacement that curves over it is underestimated by sigma^2 / 2 times its Laplacian.

    image1, image2 (shape (z, y), or (x, z, y) of volumes): on one device, where the result stays
        too.
    template, search, stride: pixels, see `windows.Windows`. The first pass covers displacements up
        to search - template - 1/2 px where an image is large enough for search regions of twice the
        size, else (and in volumes) half of that.
    min_correlation: vectors whose deformed windows correlate less are flagged; -1 to 1.
    noise: standard deviation of the images' white noise. A map does not weight the pixels; standard
        errors are those of the mean in a window. Default: from the images' spectra.
    settings: default: those of images or of volumes.
    partly: whether windows that hold non-finite pixels have a displacement from the others, if
        these are more than half of the weight. They are flagged all the same.

    Raises InputError: sizes, threshold or noise out of range; images that differ in size.

    Returns
    -------
    Displacement
        At the windows' centres at mid-time; times 1 / dt the wind there, the paths' curvature
        taken into account. `score` is the weighted correlation of the deformed windows. The
        covariance is from the images' noise, or the fit's residual where that is more, and from
        the displacement's curvature over the window.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    image_pair(image1, image2, (2, 3))
    windows = Windows(tuple(image1.shape), template, search, stride)
    if settings is None:
        settings = MultipassSettings() if windows.dims == 2 else VOLUME_MULTIPASS
    grid_of_noise = noise if isinstance(noise, torch.Tensor) and noise.ndim else None
    noise = noise if noise is None else rms(noise)
    spline, noise = band_limited(normalised([image1, image2]), noise, settings=settings.filter)
    sigma = settings.sigma * template
    grid = Grid.of(windows, spline.coefficients)
    pair = Pair(
        spline,
        informative([image1, image2]),
        # of the difference of two images
        2 * noise**2 * spline.excess,
        _relative_variance(grid_of_noise, grid),
        settings.gradient,
        settings.rebalanced,
    )
    flow, replaced = first_pass([image1, image2], spline, windows, grid)
    for width in settings.widths[:-1]:
        # vectors much closer than a window's width are redundant
        step = max(1, round(settings.spacing * width * sigma))
        places = [torch.arange(0, n, step, device=image1.device) for n in grid.shape]
        fit = _fit(pair, flow, grid, places, width * sigma)
        predictor, wrong = validated(
            fit.displacement,
            max(1, round(width * sigma / step)),
            settings.median_threshold,
            settings.median_epsilon,
            settings.continued,
        )
        flow = grid.interpolated(predictor, places)
        replaced = grid.interpolated(wrong[None], places)[0] > 0.5
    places = grid.windows(windows)
    fit = _fit(pair, flow, grid, places, settings.widths[-1] * sigma)
    # the fit gives the chord of a curved path
    d = travelled(fit.displacement, fit.gradient)
    curved = _curved(fit, sigma, stride, max(1, round(template / 2 / stride)))
    curved = torch.diag_embed(curved.movedim(0, -1)).movedim((-2, -1), (0, 1))
    matched = (fit.score > 0) & (fit.fraction_valid > 0.5)
    at = torch.meshgrid(*places, indexing="ij")
    # the linearisation does not hold that far from its displacement
    off = (d - torch.stack([part[at] for part in flow])).norm(dim=0) > max(settings.jump, sigma)
    bad = non_finite([image1, image2], windows)
    flag = (
        Flag.NO_MATCH * ~matched
        + Flag.NO_SUBPIXEL_FIT * (matched & off)
        + Flag.LOW_CORRELATION * (matched & (fit.score < min_correlation))
        + Flag.REPLACED * replaced[at]
    ).to(torch.int16)
    flag[bad] |= Flag.NON_FINITE_INPUT.value
    d = torch.where(matched if partly else matched & ~bad, d, torch.nan)
    return Displacement(d, fit.score, flag, fit.covariance + curved)


def travelled(d: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """Wind times dt at mid-time, from the chord of the path and its gradient.

    In a wind u that is linear about the place, with the matrix L, air half a time step to both
    sides is exp(+-L dt / 2) away: the chord is d = 2 tanh(L dt / 2) x where the wind is L x, so
    u dt = 2 artanh(G / 2) G^-1 d with the chord's gradient G. A rotation by 51 degrees in dt
    (Lamb-Oseen core of 3 m and 400 m^2/s, 0.1 s) makes the chord 7 % too long for the place at its
    middle. The series is cut after G^4, which leaves 0.1 % of that, and is not applied where
    |G| > 3/2.

    d (components, ...)
    gradient (components, components, ...): [i, j] is the derivative of component i along axis j.
    """
    g = gradient.flatten(2).permute(2, 0, 1)
    chord = d.flatten(1).T[..., None]
    square = g @ g
    # 2 artanh(x / 2) / x = 1 + x^2 / 12 + x^4 / 80 + ...
    arc = chord + square @ (chord / 12 + square @ chord / 80)
    # the series converges where |G| < 2
    small = g.square().sum((1, 2)) < 1.5**2
    return torch.where(small[:, None, None], arc, chord)[..., 0].T.reshape(d.shape)


def _curved(fit: "_Fit", sigma: float, stride: int, reach: int) -> torch.Tensor:
    """Variance (components, ...) by the displacement's curvature over Gaussian windows.

    The part by noise is subtracted: for white noise a gradient has 1 / (2 sigma^2) of the
    displacement's variance.
    """
    laplacian, by_noise = curvature(fit.gradient, reach)
    variance = fit.covariance.diagonal().movedim(-1, 0)
    square = laplacian.square() - by_noise * variance / (2 * sigma**2)
    everywhere = torch.ones_like(laplacian[0], dtype=torch.bool)
    near = torch.stack([averaged(part, everywhere, _NEAR) for part in square])
    # a Gaussian window changes a displacement by sigma^2 / 2 times its Laplacian (here per vector)
    return _CURVATURE_FACTOR * (sigma**2 / 2 / stride) ** 2 * near.clamp(min=0.0)


def curvature(gradient: torch.Tensor, reach: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Laplacian (components, ...) of a displacement from its gradient at places `reach` apart.

    Per place; from one side at the rim, zero along a direction with a single place. And its
    variance (...) over that of the gradients, of independent errors.
    """
    total = torch.zeros_like(gradient[:, 0])
    by_noise = torch.zeros_like(total[0])
    for axis in range(1, total.ndim):
        part = gradient[:, axis - 1]
        n = part.shape[axis]
        place = torch.arange(n, device=part.device)
        ends = [(place + move).clamp(0, n - 1) for move in (reach, -reach)]
        separation = ends[0] - ends[1]
        span = separation.clamp(min=1).to(part).reshape(-1, *[1] * (part.ndim - 1 - axis))
        change = part.index_select(axis, ends[0]) - part.index_select(axis, ends[1])
        total += change / span
        # a difference of two values has twice their variance
        by_noise += 2 * (separation.reshape(span.shape) > 0) / span**2
    return total, by_noise


class Pair(NamedTuple):
    """Two images with their noise and the prior.

    `spline` through both, which pixels are `usable` (images, ...), `variance` of a displacement
    times the sum of squared slopes, that of each pixel's noise `relative` to the mean (...),
    standard deviation of a displacement `gradient` a priori, whether their brightness is
    `rebalanced` in every pass.
    """

    spline: Spline
    usable: torch.Tensor
    variance: float
    relative: torch.Tensor
    gradient: float
    rebalanced: bool


def _relative_variance(noise: torch.Tensor | None, grid: Grid) -> torch.Tensor:
    """Variance of a map of noise over its mean, on a grid; 1 of a noise that is no map.

    Half a pixel from the grid's places at most.
    """
    uniform = torch.ones(grid.shape).to(grid.like)
    if noise is None:
        return uniform
    square = noise[tuple(map(slice, grid.shape))].to(uniform).square()
    mean = square[square.isfinite()].mean()
    return torch.where(square.isfinite() & (mean > 0), square / mean, uniform)


class _Fit(NamedTuple):
    """Affine displacement of windows, in px.

    `displacement` (n, ...), `gradient` (n, n, ...) by component and axis, weighted correlation
    `score` (0 where there is no texture), `covariance` (n, n, ...) of the displacement,
    `fraction_valid` of the window's weight where both images are valid.
    """

    displacement: torch.Tensor
    gradient: torch.Tensor
    score: torch.Tensor
    covariance: torch.Tensor
    fraction_valid: torch.Tensor


def _fit(
    pair: Pair, flow: torch.Tensor, grid: Grid, places: Sequence[torch.Tensor], sigma: float
) -> _Fit:
    """The affine displacement about each place that makes the images agree there, as `_Fit`.

    With the images read at x -+ flow / 2, their difference r and the slope g of their mean, the
    sum over a Gaussian window of (r - g flow + g (a + A x))^2 is minimised. The gradient's standard
    deviation a priori regularises it where there is little texture.
    """
    dims = len(places)
    # weights further away are 1 % of the largest or less
    reach = math.ceil(3 * sigma)
    # in units of sigma: displacement and gradient have columns of one size
    x = torch.arange(-reach, reach + 1, dtype=flow.dtype, device=flow.device) / sigma
    gaussian = torch.exp(-(x**2) / 2)
    # the covariance of a weighted fit has the squares of the weights
    kernels = [[w * x**power for power in range(3)] for w in (gaussian, gaussian**2)]
    steps = [int(at[1] - at[0]) if len(at) > 1 else 1 for at in places]
    # products of slopes, then those with the shift, then the fields summed without moments
    squares = dims * (dims + 1) // 2
    whole = float(gaussian.sum()) ** dims
    # a band repeats its neighbours' margins: thin volumes are best done at once
    most_bytes = geometry.tile_bytes() * (1 if dims == 2 else 8)
    rows = max(1, most_bytes // (8 * 100 * steps[0] * math.prod(grid.shape[1:])))
    bands = []
    for part in places[0].split(rows):
        top, stop = int(part[0]) - reach, int(part[-1]) + reach + 1
        within = slice(max(0, top), min(stop, grid.shape[0]))
        fields = _products(pair, flow[:, within], grid.places(within), pair.relative[within])
        rims = [(within.start - top, stop - within.stop)]
        for at, n in zip(places[1:], grid.shape[1:], strict=True):
            first, last = int(at[0]), int(at[-1]) + 1
            low, high = max(0, first - reach), min(n, last + reach)
            fields = fields.narrow(len(rims) + 1, low, high - low)
            rims.append((max(0, reach - first), max(0, last + reach - n)))
        once = _moments(fields[: squares + dims], kernels[0], steps, rims, 2)
        twice = _moments(fields[:squares], kernels[1], steps, rims, 2)
        unweighted = _moments(fields[squares + dims :], kernels[0], steps, rims, 0)[(0,) * dims]
        bands.append(_solved(once, twice, unweighted, sigma, pair, whole))
    return _Fit(*(torch.cat(parts, dim=-dims) for parts in zip(*bands, strict=True)))


def _products(
    pair: Pair, flow: torch.Tensor, places: Sequence[torch.Tensor], relative: torch.Tensor
) -> torch.Tensor:
    """The fields summed over windows: products of slopes, of slopes and shift, of the images.

    And the relative variance of the noise there.

    Zero where one of the images is not valid.
    """
    # symmetric in time, so that vectors are those at mid-time
    at = [torch.stack([p - d / 2, p + d / 2]) for p, d in zip(places, flow, strict=True)]
    value, *slopes = pair.spline.sample(*at)
    valid = (pair.spline.holds(*at) & nearest(pair.usable, at)).all(0)
    if pair.rebalanced:
        value, gain = normalised_intensity(value, valid.to(value))
        slopes = [gain * part for part in slopes]
    slope = torch.stack([part.mean(0) for part in slopes])
    shift = (slope * flow).sum(0) - (value[1] - value[0])
    rows = [slope[a] * slope[b] for a, b in _pairs(len(slope))]
    rows += [*(slope * shift), shift**2, *value, *value**2, value[0] * value[1], relative]
    return torch.stack([*rows, torch.ones_like(shift)]) * valid


def _moments(
    fields: torch.Tensor,
    kernels: Sequence[torch.Tensor],
    steps: Sequence[int],
    rims: Sequence[tuple[int, int]],
    order: int,
) -> dict[tuple[int, ...], torch.Tensor]:
    """Sums of fields (n, ...) over windows, times powers (p, q, ...) of the place in it.

    Up to `order` of them together; beyond the rims the fields are zero.
    """
    moments: dict[tuple[int, ...], torch.Tensor] = {(): fields}
    for axis, (step, rim) in enumerate(zip(steps, rims, strict=True)):
        after: dict[tuple[int, ...], torch.Tensor] = {}
        for powers, sums in moments.items():
            sums = pad(sums, (0, 0) * (sums.ndim - 2 - axis) + rim)
            parts = window_sums(sums, kernels[: order + 1 - sum(powers)], step, axis + 1)
            after |= {(*powers, p): part for p, part in enumerate(parts)}
        moments = after
    return {powers: working(sums) for powers, sums in moments.items()}


def _pairs(dims: int) -> list[tuple[int, int]]:
    return list(combinations_with_replacement(range(dims), 2))


def _terms(dims: int) -> list[tuple[int, ...]]:
    """Powers of the coordinates in the affine displacement's terms: 1, then each coordinate."""
    return [tuple(int(axis == a) for a in range(dims)) for axis in range(-1, dims)]


def _normal(moments: dict[tuple[int, ...], torch.Tensor], dims: int) -> torch.Tensor:
    """Matrix (..., unknown, unknown) of the affine fit; terms of the first axis first."""
    number = {pair: i for i, pair in enumerate(_pairs(dims))}
    unknowns = [(a, term) for a in range(dims) for term in _terms(dims)]
    rows = [
        moments[tuple(i + j for i, j in zip(first, second, strict=True))][
            number[min(a, b), max(a, b)]
        ]
        for a, first in unknowns
        for b, second in unknowns
    ]
    return torch.stack(rows, -1).unflatten(-1, (len(unknowns),) * 2)


def _solved(
    once: dict[tuple[int, ...], torch.Tensor],
    twice: dict[tuple[int, ...], torch.Tensor],
    unweighted: torch.Tensor,
    sigma: float,
    pair: Pair,
    whole: float,
) -> tuple[torch.Tensor, ...]:
    """The fields of `_Fit`, from the sums over the windows.

    The covariance is that of a weighted fit to white noise: of the pair's variance, or of the
    residual difference of the images where that is more.
    """
    dims = unweighted.ndim - 1
    terms = _terms(dims)
    misfit, *means, square1, square2, cross, relative, number = unweighted
    fraction_valid = number / whole
    number = number.clamp(min=1e-12)
    covary = cross - means[0] * means[1] / number
    contrast = [s - mean**2 / number for s, mean in zip((square1, square2), means, strict=True)]
    scale = (contrast[0].clamp(min=0) * contrast[1].clamp(min=0)).sqrt()
    normal = _normal(once, dims)
    first = len(_pairs(dims))
    wanted = torch.stack([once[term][first + a] for a in range(dims) for term in terms], -1)
    spread = normal.diagonal(dim1=-2, dim2=-1)
    rounding = torch.finfo(pair.spline.coefficients.dtype).eps * (square1 * square2).sqrt()
    textured = (spread.amin(-1) > 0) & (scale > rounding)
    # gradients have a prior, the displacement itself has none
    prior = torch.tensor([0.0, *[1.0] * dims] * dims, dtype=spread.dtype, device=spread.device)
    prior = prior * pair.variance / (pair.gradient * sigma) ** 2
    # without texture the matrix is singular: such windows get a solution that is not used
    floor = 1e-9 * spread.mean(-1, keepdim=True) + ~textured[..., None]
    normal = normal + torch.diag_embed(prior + floor)
    unit = torch.eye(normal.shape[-1], dtype=spread.dtype, device=spread.device)
    root, failed = torch.linalg.cholesky_ex(normal)
    # where few voxels are known the sums' rounding may be more than the floor
    singular = (failed > 0)[..., None, None]
    normal, root = (torch.where(singular, unit, part) for part in (normal, root))
    textured = textured & (failed == 0)
    right = torch.cat([wanted[..., None], unit[:, :: dims + 1].expand(*wanted.shape, dims)], -1)
    answer = torch.cholesky_solve(right, root)
    solution, inverse = answer[..., 0], answer[..., 1:]
    # |r|^2 - 2 b.s + s.N s, the squared residual of the solution s, from the sums alone
    residual = misfit - (2 * wanted - (normal @ solution[..., None])[..., 0]).mul(solution).sum(-1)
    stated = pair.variance * relative / number
    # the filter passes only this fraction of the variance of white noise
    residual = torch.maximum(residual / number / pair.spline.passed, stated)
    # the sandwich: Gaussian weights are not inverse variances of the noise
    covariance = inverse.mT @ _normal(twice, dims) @ inverse * residual[..., None, None]
    solution = solution.unflatten(-1, (dims, dims + 1)).movedim((-2, -1), (0, 1))
    return (
        solution[:, 0],
        solution[:, 1:] / sigma,
        torch.where(textured, covary / scale, 0.0),
        covariance.movedim((-2, -1), (0, 1)),
        fraction_valid,
    )
