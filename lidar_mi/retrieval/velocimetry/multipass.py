"""Multi-pass correlation: coarse to fine, both images deformed half way (multipass).

The first pass correlates windows twice as large over twice the range. Every later pass deforms
both images by half of what is known so far, in opposite directions, and fits an affine
displacement to what is left in each window, weighted by a Gaussian. Between passes vectors that
their neighbours contradict are replaced.
"""

import math
from typing import NamedTuple

import torch
from torch.nn.functional import grid_sample, pad

from lidar_mi.retrieval.velocimetry import windows as geometry
from lidar_mi.retrieval.velocimetry.correlation import cross_correlation
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.quality import (
    Flag,
    check_between,
    median_outliers,
    neighbour_median,
    non_finite,
)
from lidar_mi.retrieval.velocimetry.warping import Spline, band_limited, levelled, rms
from lidar_mi.retrieval.velocimetry.windows import Windows, image_pair

# Widths of the Gaussian windows, pass by pass, over the last one.
_WIDTHS = (1.8, 1.4, 1.0)
# Terms of the affine displacement: powers of (z, y).
_TERMS = ((0, 0), (1, 0), (0, 1))
# Windows summed at once: more waste products with zeros, fewer are too small to be fast.
_BLOCK = 48


def multipass(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    min_correlation: float = 0.5,
    noise: float | torch.Tensor | None = None,
) -> Displacement:
    """Displacement of every window by correlation of images deformed to fit, coarse to fine.

    Window deformation after Scarano (2002, Meas. Sci. Technol. 13, R1-R19), symmetric in time.
    Where images are deformed well already, the shift of highest correlation is the least squares
    solution of the linearised difference of the images, which the later passes solve at once for
    displacement and displacement gradient (affine), both of the whole motion and not of the rest:
    so noise in the predictor does not add up from pass to pass. Images are band-limited before
    (see `warping.band_limited`) and may differ in brightness by a factor and an offset.

    A Gaussian window with a standard deviation sigma of a third of the template weights the
    pixels; displacement that curves over it is underestimated by sigma^2 / 2 times its Laplacian.

    Parameters
    ----------
    image1, image2 : torch.Tensor, shape (z, y)
        On one device, where the result stays too.
    template, search, stride : int
        Pixels, see `windows.Windows`. The first pass sees displacements up to search - template -
        1/2 px, where the image holds search regions of twice the size, else half of that.
    min_correlation : float
        Vectors whose deformed windows correlate less are flagged; -1 to 1.
    noise : float or torch.Tensor, optional
        Standard deviation of the images' white noise, of an image of them the rms; left out: from
        the images' spectra.

    Returns
    -------
    Displacement
        At the windows' centres at mid-time; times 1 / dt the wind there, the paths' curvature
        taken into account. `score` is the weighted correlation of the deformed windows. The
        covariance holds the images' noise, or what the fit leaves where that is more, and the
        displacement's curvature over the window.

    Raises
    ------
    InputError
        Sizes, threshold or noise out of range; images that differ in size.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    noise = noise if noise is None else rms(noise)
    spline, noise = band_limited(levelled([image1, image2]), noise)
    sigma = template / 3
    grid = Grid.of(windows, spline.coefficients)
    flow, replaced = first_pass(image1, image2, windows, grid)
    variance = 2 * noise**2 * spline.excess
    for width in _WIDTHS[:-1]:
        step = max(1, round(width * sigma / 2))
        rows, columns = (torch.arange(0, n, step, device=image1.device) for n in grid.shape)
        fit = _fit(spline, flow, grid, rows, columns, width * sigma, variance)
        found, wrong = validated(fit.displacement, max(1, round(width * sigma / step)))
        flow = grid.spread(found, rows, columns)
        replaced = grid.spread(wrong.to(flow)[None], rows, columns)[0] > 0.5
    rows, columns = grid.windows(windows)
    fit = _fit(spline, flow, grid, rows, columns, sigma, variance)
    d = travelled(fit.displacement, fit.gradient)
    covariance = fit.covariance.clone()
    # far enough apart that the gradients' noise adds little
    bent = curvature(fit.gradient, max(1, round(template / 2 / stride))) / stride
    covariance[:2] += (sigma**2 / 2 * bent).square()
    matched = fit.score > 0
    off = (d - flow[:, rows][:, :, columns]).norm(dim=0) > max(2.0, sigma)
    bad = non_finite(image1, image2, windows)
    d = torch.where(bad | ~matched, torch.nan, d)
    flag = (
        Flag.NO_MATCH * ~matched
        + Flag.NO_SUBPIXEL_FIT * (matched & off)
        + Flag.LOW_CORRELATION * (matched & (fit.score < min_correlation))
        + Flag.REPLACED * replaced[rows][:, columns]
    ).to(torch.uint8)
    flag[bad] |= Flag.NON_FINITE_INPUT.value
    return Displacement(d[0], d[1], fit.score, flag, covariance)


class Grid(NamedTuple):
    """Places one pixel apart that the windows' centres are among: pixels, or half way between.

    Attributes
    ----------
    shape : (int, int)
    offset : float
        Of the first place from the first pixel, 0 or 1/2 px.
    like : torch.Tensor
        Empty, of the type and device to work in.
    """

    shape: tuple[int, int]
    offset: float
    like: torch.Tensor

    @classmethod
    def of(cls, windows: Windows, like: torch.Tensor) -> "Grid":
        even = windows.template % 2 == 0
        return cls(tuple(n - even for n in windows.shape), even / 2, like[:0])

    def windows(self, windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and columns of this grid that the windows' centres are on."""
        first = windows.lead + (windows.template - 1) // 2
        rows, columns = (
            first + windows.stride * torch.arange(n, device=self.like.device) for n in windows.count
        )
        return rows, columns

    def places(self, rows: slice = slice(None)) -> tuple[torch.Tensor, torch.Tensor]:
        """z and y (px) of the grid's rows and columns, as they broadcast."""
        z, y = (
            torch.arange(n, dtype=self.like.dtype, device=self.like.device) + self.offset
            for n in self.shape
        )
        return z[rows, None], y[None, :]

    def spread(
        self, values: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor
    ) -> torch.Tensor:
        """Values (fields, rows, columns) at some evenly spaced places, on all, by cubics.

        Places outside take the nearest value.
        """
        along = []
        for axis, (n, known) in enumerate(zip(self.shape, (rows, columns))):
            known = known.to(self.like)
            place = torch.arange(n, dtype=known.dtype, device=known.device)
            span = (known[-1] - known[0]).clamp(min=1)
            along.append(2 * (place - known[0]) / span - 1)
        points = torch.stack(torch.meshgrid(*reversed(along), indexing="xy"), -1)
        return grid_sample(
            values[None], points[None], "bicubic", padding_mode="border", align_corners=True
        )[0]


def first_pass(
    image1: torch.Tensor, image2: torch.Tensor, windows: Windows, grid: Grid
) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacement (2, *grid.shape) from windows twice as large, and where it was replaced.

    Windows that correlation flags or their neighbours contradict take the neighbours' median.
    Where the image holds no regions of twice the size, the windows are taken as they are.
    """
    double = 2 if min(windows.shape) >= 2 * windows.search else 1
    template, search = double * windows.template, double * windows.search
    coarse = Windows(windows.shape, template, search, max(1, template // 2))
    found = cross_correlation(image1, image2, template, search, coarse.stride)
    usable = (found.flag == 0) | (found.flag == Flag.NO_SUBPIXEL_FIT.value)
    d = torch.where(usable, torch.stack([found.dz, found.dy]), torch.nan)
    d, wrong = validated(d, 1)
    rows, columns = (
        torch.as_tensor(coarse.starts(axis), device=image1.device)
        + (template - 1) / 2
        - grid.offset
        for axis in (0, 1)
    )
    flow = grid.spread(d, rows, columns)
    return flow, grid.spread(wrong.to(flow)[None], rows, columns)[0] > 0.5


def validated(d: torch.Tensor, spacing: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacements (2, rows, columns) with outliers and gaps filled from their neighbours.

    Outliers are those of the normalised median test. Gaps take the median of their neighbours,
    from the rim of a gap inwards; without any vector at all the displacement is zero. Returns
    them and what was replaced.
    """
    wrong = d.isnan().any(0) | median_outliers(d[0], d[1], spacing=spacing)
    d = torch.where(wrong, torch.nan, d)
    while bool((gap := d[0].isnan()).any()) and not bool(gap.all()):
        d = torch.where(gap, torch.stack([neighbour_median(part) for part in d]), d)
    return d.nan_to_num(0.0), wrong


def travelled(d: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """Wind times dt at mid-time, from the chord of the path and its gradient.

    In a wind u that is linear about the place, with the matrix L, air half a time step to both
    sides is exp(+-L dt / 2) away: the chord is d = 2 tanh(L dt / 2) x where the wind is L x, so
    u dt = 2 artanh(G / 2) G^-1 d with the chord's gradient G. A rotation by 51 degrees in dt
    (Lamb-Oseen core of 3 m and 400 m^2/s, 0.1 s) makes the chord 7 % too long for the place at its
    middle. The series is cut after G^4, which leaves 0.1 % of that, and is not applied where
    |G| > 3/2.

    Parameters
    ----------
    d : torch.Tensor, shape (2, ...)
    gradient : torch.Tensor, shape (2, 2, ...)
        [i, j] is the derivative of component i along axis j.
    """
    g = gradient.flatten(2).permute(2, 0, 1)
    chord = d.flatten(1).T[..., None]
    square = g @ g
    arc = chord + square @ (chord / 12 + square @ chord / 80)
    small = g.square().sum((1, 2)) < 1.5**2
    return torch.where(small[:, None, None], arc, chord)[..., 0].T.reshape(d.shape)


def curvature(gradient: torch.Tensor, reach: int) -> torch.Tensor:
    """Laplacian (2, rows, columns) of a displacement from its gradient at places `reach` apart.

    Per place; from one side at the rim, zero along a direction with a single place.
    """
    total = torch.zeros_like(gradient[:, 0])
    for axis in (1, 2):
        part = gradient[:, axis - 1]
        n = part.shape[axis]
        place = torch.arange(n, device=part.device)
        ends = [(place + move).clamp(0, n - 1) for move in (reach, -reach)]
        span = (ends[0] - ends[1]).clamp(min=1).to(part)
        change = part.index_select(axis, ends[0]) - part.index_select(axis, ends[1])
        total += change / (span[:, None] if axis == 1 else span)
    return total


class _Fit(NamedTuple):
    """Affine displacement of windows (rows, columns), in px.

    `displacement` (2, ...), `gradient` (2, 2, ...) by component and axis, weighted correlation
    `score` (0 where there is no texture) and `covariance` (3, ...) of the displacement: zz, yy, zy.
    """

    displacement: torch.Tensor
    gradient: torch.Tensor
    score: torch.Tensor
    covariance: torch.Tensor


def _fit(
    spline: Spline,
    flow: torch.Tensor,
    grid: Grid,
    rows: torch.Tensor,
    columns: torch.Tensor,
    sigma: float,
    variance: float,
) -> _Fit:
    """The affine displacement about each place that makes the images agree there, as `_Fit`.

    With the images read at x -+ flow / 2, their difference r and the slope g of their mean, the
    sum over a Gaussian window of (r - g flow + g (a + A x))^2 is least. A displacement gradient of
    1 in a window would make air change places: that is its standard deviation a priori, which
    decides where the texture does not.
    """
    reach = math.ceil(3 * sigma)
    x = torch.arange(-reach, reach + 1, dtype=flow.dtype, device=flow.device) / sigma
    bell = torch.exp(-(x**2) / 2)
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    bands = []
    for part in rows.split(max(1, geometry.TILE_BYTES // (8 * 100 * step * grid.shape[1]))):
        top, stop = int(part[0]) - reach, int(part[-1]) + reach + 1
        seen = slice(max(0, top), min(stop, grid.shape[0]))
        fields = _products(spline, flow[:, seen], grid.places(seen))
        fields = pad(fields, (reach, reach, seen.start - top, stop - seen.stop))
        fields = fields[..., int(columns[0]) : int(columns[-1]) + 2 * reach + 1]
        side = int(columns[1] - columns[0]) if len(columns) > 1 else 1
        steps = step, side
        bells = [[w * x**power for power in range(3)] for w in (bell, bell**2)]
        once, twice = (_moments(fields[:5], bells[0], steps), _moments(fields[:3], bells[1], steps))
        plain = window_sums(
            window_sums(fields[5:], bells[0][:1], step, 1)[0], bells[0][:1], side, 2
        )
        bands.append(_solved(once, twice, plain[0], sigma, variance, spline.passed))
    return _Fit(*(torch.cat(parts, dim=-2) for parts in zip(*bands)))


def _products(
    spline: Spline, flow: torch.Tensor, places: tuple[torch.Tensor, torch.Tensor]
) -> torch.Tensor:
    """What is summed over windows: products of slopes, of slopes and shift, of the images.

    Zero where one of the images was not seen.
    """
    places = [place.expand_as(flow[0]) for place in places]
    z, y = (torch.stack([place - d / 2, place + d / 2]) for place, d in zip(places, flow))
    value, slope_z, slope_y = spline.sample(z, y)
    seen = spline.holds(z, y).all(0)
    slope = torch.stack([slope_z.mean(0), slope_y.mean(0)])
    shift = (slope * flow).sum(0) - (value[1] - value[0])
    pairs = [
        slope[0] ** 2,
        slope[0] * slope[1],
        slope[1] ** 2,
        *(slope * shift),
        shift**2,
        *value,
        *value**2,
        value[0] * value[1],
        torch.ones_like(shift),
    ]
    return torch.stack(pairs) * seen


def _moments(
    fields: torch.Tensor, kernels: list[torch.Tensor], steps: tuple[int, int]
) -> dict[tuple[int, int], torch.Tensor]:
    """Sums of fields (n, rows, columns) over windows, times powers (p, q) of the place in it."""
    found = {}
    for p, rows in enumerate(window_sums(fields, kernels, steps[0], 1)):
        for q, sums in enumerate(window_sums(rows, kernels[: 3 - p], steps[1], 2)):
            found[p, q] = sums
    return found


def window_sums(
    fields: torch.Tensor, kernels: list[torch.Tensor], step: int, axis: int
) -> torch.Tensor:
    """Sums along an axis of fields (n, rows, columns), weighted by each of several kernels.

    One sum begins every `step` values, as long as the kernel is covered. Multiplies blocks of
    values with all kernels at once, which takes a tenth of the time of a convolution.

    Returns
    -------
    torch.Tensor, shape (kernels, n, ...)
    """
    taps = len(kernels[0])
    fields = fields.movedim(axis, -1)
    number = (fields.shape[-1] - taps) // step + 1
    block = min(number, max(1, _BLOCK // step))
    blocks = -(-number // block)
    length = (block - 1) * step + taps
    fields = pad(fields, (0, max(0, (blocks - 1) * block * step + length - fields.shape[-1])))
    weights = fields.new_zeros(len(kernels), length, block)
    for i in range(block):
        for weight, kernel in zip(weights, kernels):
            weight[i * step : i * step + taps, i] = kernel
    pieces = fields.unfold(-1, length, block * step)
    sums = pieces.reshape(1, -1, length) @ weights
    sums = sums.reshape(len(kernels), *fields.shape[:-1], blocks * block)[..., :number]
    return sums.movedim(-1, axis + 1)


def _normal(moments: dict[tuple[int, int], torch.Tensor]) -> torch.Tensor:
    """Matrix (rows, columns, 6, 6) of the affine fit; terms of z first, then those of y."""
    rows = []
    for a in (0, 1):
        for first in _TERMS:
            rows += [
                moments[first[0] + second[0], first[1] + second[1]][a + b]
                for b in (0, 1)
                for second in _TERMS
            ]
    return torch.stack(rows, -1).unflatten(-1, (6, 6))


def _solved(
    once: dict[tuple[int, int], torch.Tensor],
    twice: dict[tuple[int, int], torch.Tensor],
    plain: torch.Tensor,
    sigma: float,
    variance: float,
    passed: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """What `_Fit` holds, from the sums over the windows.

    The covariance is that of a weighted fit to white noise: of the `variance` given, or what the
    fit leaves of the difference of the images where that is more.
    """
    misfit, *means, number = plain[[0, 1, 2, 6]]
    number = number.clamp(min=1e-12)
    covary = plain[5] - means[0] * means[1] / number
    contrast = [plain[3 + i] - means[i] ** 2 / number for i in (0, 1)]
    scale = (contrast[0].clamp(min=0) * contrast[1].clamp(min=0)).sqrt()
    normal = _normal(once)
    wanted = torch.stack([once[term][3 + a] for a in (0, 1) for term in _TERMS], -1)
    spread = normal.diagonal(dim1=-2, dim2=-1)
    textured = (spread.amin(-1) > 0) & (scale > 0)
    prior = torch.tensor([0, 1, 1, 0, 1, 1], dtype=spread.dtype, device=spread.device)
    floor = 1e-9 * spread.mean(-1, keepdim=True) + ~textured[..., None]
    normal = normal + torch.diag_embed(prior * variance / sigma**2 + floor)
    root = torch.linalg.cholesky(normal)
    unit = torch.eye(6, dtype=spread.dtype, device=spread.device)[:, [0, 3]]
    right = torch.cat([wanted[..., None], unit.expand(*wanted.shape, 2)], -1)
    answer = torch.cholesky_solve(right, root)
    solution, inverse = answer[..., 0], answer[..., 1:]
    left = misfit - (2 * wanted - (normal @ solution[..., None])[..., 0]).mul(solution).sum(-1)
    left = torch.maximum(left / number / passed, torch.as_tensor(variance).to(left))
    covariance = inverse.mT @ _normal(twice) @ inverse * left[..., None, None]
    solution = solution.unflatten(-1, (2, 3)).permute(2, 3, 0, 1)
    return (
        solution[:, 0],
        solution[:, 1:] / sigma,
        torch.where(textured, covary / scale, 0.0),
        torch.stack([covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 0, 1]]),
    )
