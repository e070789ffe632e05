"""Volumetric correlation: coarse to fine, both volumes deformed half way.

The first pass correlates windows of volumes of half the resolution at whole shifts and fits the
peak. Every later pass deforms both volumes by half of what is known, in opposite directions, and
fits an affine displacement to what is left in each Gaussian window.
"""

from itertools import product
from typing import NamedTuple

import torch
from torch.nn.functional import avg_pool3d, pad

from lidar_mi.retrieval.velocimetry.multipass import travelled
from lidar_mi.retrieval.velocimetry.quality import Flag
from lidar_mi.retrieval.velocimetry.volume_field import Volumes
from lidar_mi.retrieval.velocimetry.volume_windows import (
    VolumeDisplacement,
    VolumeWindows,
    along_x,
    bells,
    flags,
    hats,
    median_outliers,
    separable,
    validated,
)

# Widths of the Gaussian windows, pass by pass, over the last one.
_WIDTHS = (1.8, 1.4)
# Voxels of a field that are worked on at once, whole planes of constant z.
SLAB = 1 << 20
# Terms of the affine displacement: powers of (x, z, y).
_TERMS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def correlated(
    images: Volumes, windows: VolumeWindows, min_correlation: float = 0.5
) -> VolumeDisplacement:
    """Displacement of every window by correlation of volumes deformed to fit, coarse to fine.

    The volumetric form of `multipass.multipass` (window deformation, Scarano 2002, Meas. Sci.
    Technol. 13, R1-R19; in volumes Elsinga et al. 2006, Exp. Fluids 41, 933-947): where volumes are
    deformed well already, the shift of highest correlation is the least squares solution of their
    linearised difference, taken for the displacement and its nine gradients. Passes use Gaussian
    windows 1.8, 1.4 and 1 times a standard deviation s of a third of the template; between them
    outliers are replaced. What bends over a window is underestimated by s^2 / 2 times its Laplacian,
    which is in the variance.

    Parameters
    ----------
    images : Volumes
        Two.
    windows : VolumeWindows
    min_correlation : float
        Vectors whose deformed windows correlate less are flagged.
    """
    sigma = windows.template / 3
    coarse, flow, wrong = settled(images, windows)
    replaced = _between(wrong.double(), coarse, windows) > 0.5
    fit = _fit(images, coarse, flow, windows, sigma)
    d = travelled(fit.displacement, fit.gradient)
    variance = fit.variance + (sigma**2 / 2 * _laplacian(fit.gradient, windows)).square()
    before = _between(flow, coarse, windows)
    off = (d - before).norm(dim=0) > max(2.0, sigma)
    finite = _finite(images, windows)
    flag = flags(d, variance, fit.score, fit.share, finite, min_correlation)
    nothing = (flag & (Flag.NO_MATCH | Flag.NON_FINITE_INPUT)) != 0
    d = torch.where(nothing, torch.nan, d)
    flag |= (
        Flag.NO_SUBPIXEL_FIT * (off & ~nothing)
        + Flag.REPLACED * replaced
        + Flag.MEDIAN_OUTLIER * median_outliers(d)
    ).to(torch.uint8)
    return VolumeDisplacement(
        d, torch.where(nothing, torch.nan, variance), fit.score.nan_to_num(0.0), flag
    )


def settled(
    images: Volumes, windows: VolumeWindows
) -> tuple[VolumeWindows, torch.Tensor, torch.Tensor]:
    """All passes but the last: their windows, displacements (3, ...), and which were replaced."""
    known, flow = predicted(images, windows)
    stride = max(windows.stride, windows.template // 2)
    coarse = VolumeWindows(windows.shape, windows.template, windows.search, stride)
    for width in _WIDTHS:
        fit = _fit(images, known, flow, coarse, width * windows.template / 3)
        flow, wrong = validated(torch.where(fit.score > 0, fit.displacement, torch.nan))
        known = coarse
    return coarse, flow, wrong


def predicted(images: Volumes, windows: VolumeWindows) -> tuple[VolumeWindows, torch.Tensor]:
    """A first displacement (voxels) of windows about twice the template, from whole shifts.

    Normalised cross-correlation of volumes averaged over 2 x 2 x 2 voxels, and the top of a
    quadratic through the peak and its 26 neighbours. Returns the windows and their displacements;
    windows whose peak lies on the rim of the search take their neighbours' median.
    """
    axes = [
        torch.arange(n, dtype=torch.float32, device=images.coefficients.device)
        for n in images.shape
    ]
    whole = [axis.expand(2, *axis.shape) for axis in torch.meshgrid(*axes, indexing="ij")]
    values, _, seen = images.sample(whole)
    values = avg_pool3d((values * seen)[:, None], 2)[:, 0]
    shape = tuple(values.shape[1:])
    reach = max(1, round(windows.reach / 2))
    # windows of twice the template, as far as the volume holds them
    size = [min(windows.template, n) for n in shape]
    step = max(1, windows.template // 2)

    def sums(field):
        return avg_pool3d(field[None], size, step)[0]

    first, second = values
    ones = torch.ones_like(first)
    fields = pad(torch.stack([second, second**2, ones]), (reach,) * 6)
    mean1, square1 = sums(first), sums(first**2)
    scores = []
    for shift in product(range(2 * reach + 1), repeat=3):
        moved = fields[(slice(None), *(slice(s, s + n) for s, n in zip(shift, shape)))]
        inside = sums(moved[2])
        mean2, square2 = sums(moved[0]) / inside, sums(moved[1]) / inside
        cross = sums(first * moved[0]) / inside
        # of image 1 the part that is compared
        part1, part_square1 = sums(first * moved[2]) / inside, sums(first**2 * moved[2]) / inside
        contrast = (part_square1 - part1**2) * (square2 - mean2**2)
        score = (cross - part1 * mean2) / contrast.clamp(min=1e-12).sqrt()
        scores.append(torch.where(inside > 0.5, score, -1.0))
    scores = torch.stack(scores)
    scores = torch.where((square1 - mean1**2) > 1e-10, scores, torch.nan)
    d = 2 * _peaks(scores, reach)
    coarse = _Regular(images.shape, tuple(d.shape[1:]), tuple(2 * n for n in size), 2 * step)
    return coarse, validated(d)[0]


class _Regular(NamedTuple):
    """Windows of unlike sides, as far as places go that are interpolated between."""

    shape: tuple[int, int, int]
    count: tuple[int, int, int]
    sides: tuple[int, int, int]
    stride: int

    def centres(self, axis: int) -> torch.Tensor:
        start = (self.sides[axis] - 1) / 2
        return start + self.stride * torch.arange(self.count[axis], dtype=torch.float64)


# Values about a peak as a + b x + x' C x / 2: least squares over the 27 places.
_AROUND = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=3)), dtype=torch.float64)
_QUADRATIC = torch.linalg.pinv(
    torch.cat(
        [
            torch.ones(27, 1, dtype=torch.float64),
            _AROUND,
            torch.stack([_AROUND[:, a] * _AROUND[:, b] / (1 + (a == b)) for a, b in _PAIRS], 1),
        ],
        1,
    )
)


def _peaks(scores: torch.Tensor, reach: int) -> torch.Tensor:
    """Place (3, ...) of the highest of scores over the shifts, between shifts; NaN on the rim."""
    side = 2 * reach + 1
    shape = scores.shape[1:]
    flat = scores.nan_to_num(-2.0).reshape(len(scores), -1)
    best = flat.argmax(0)
    place = torch.stack([best // side**2, best // side % side, best % side])
    rim = ((place == 0) | (place == side - 1)).any(0)
    inner = place.clamp(1, side - 2)
    number = (_AROUND.long().to(place.device)[:, :, None] + inner).unbind(1)
    around = flat.gather(0, (number[0] * side + number[1]) * side + number[2])
    terms = _QUADRATIC.to(around) @ around
    slope = terms[1:4].T
    bend = slope.new_zeros(len(slope), 3, 3)
    for (a, b), term in zip(_PAIRS, terms[4:]):
        bend[:, a, b] = bend[:, b, a] = term
    peaked = torch.linalg.eigvalsh(bend)[:, -1] < 0
    bend = torch.where(
        peaked[:, None, None], bend, -torch.eye(3, dtype=bend.dtype, device=bend.device)
    )
    rest = -torch.linalg.solve(bend, slope[..., None])[..., 0]
    rest = torch.where((peaked & (rest.abs() < 1).all(1))[:, None], rest, 0.0).T
    d = torch.where(rim | ~(flat.amax(0) > -1), torch.nan, place - reach + rest)
    return d.reshape(3, *shape)


def _between(values: torch.Tensor, known, wanted) -> torch.Tensor:
    """Values (..., x, z, y) at windows' centres, at those of others, by trilinear interpolation."""
    return separable(
        values, [hats(known.centres(a), wanted.centres(a)).to(values) for a in range(3)]
    )


class _Fit(NamedTuple):
    """Affine displacement of windows, in voxels.

    `displacement` (3, ...), `gradient` (3, 3, ...) by component and axis, `variance` (3, ...) that
    the volumes' noise makes, or the misfit where that is more, weighted correlation `score` and
    `share` of the window's weight that was seen.
    """

    displacement: torch.Tensor
    gradient: torch.Tensor
    variance: torch.Tensor
    score: torch.Tensor
    share: torch.Tensor


def _fit(images: Volumes, known, flow, windows: VolumeWindows, sigma: float) -> _Fit:
    """The affine displacement about each centre that makes the volumes agree there.

    With the volumes read at place -+ flow / 2, their difference r and the slope g of their mean,
    the sum over a Gaussian window of (r - g flow + g (a + A x))^2 is least. A displacement gradient
    of 1 in a window would make air change places: that is its standard deviation a priori, which
    decides where the texture does not.
    """
    like = images.coefficients
    places = [torch.arange(n, dtype=like.dtype, device=like.device) for n in images.shape]
    weights = bells(windows, sigma, like)
    powers = [
        torch.stack(
            [
                bell * ((place - windows.centres(axis).to(place)[:, None]) / sigma) ** p
                for p in range(3)
            ]
        )
        for axis, (place, bell) in enumerate(zip(places, weights))
    ]
    squares = [power * bell for power, bell in zip(powers, weights)]
    to_voxels = [hats(known.centres(a).to(places[a]), places[a]) for a in range(3)]
    once, twice, plain = {}, {}, 0.0
    planes = max(1, SLAB // (images.shape[0] * images.shape[2]))
    for start in range(0, images.shape[1], planes):
        here = slice(start, start + planes)
        d = separable(flow.to(like), [to_voxels[0], to_voxels[1][here], to_voxels[2]])
        fields = _products(images, d, [places[0], places[1][here], places[2]])
        for moments, kernels, wanted in ((once, powers, fields[:9]), (twice, squares, fields[:6])):
            kernels = [kernels[0], kernels[1][:, :, here], kernels[2]]
            _add_moments(moments, wanted, kernels)
        plain = (
            plain + separable(fields[9:], [weights[0], weights[1][:, here], weights[2]]).double()
        )
    whole = separable(torch.ones(images.shape).to(like), weights).double()
    return _solved(once, twice, plain, whole, sigma, images)


def _products(images: Volumes, d: torch.Tensor, places) -> torch.Tensor:
    """What is summed over windows: products of slopes, of slopes and shift, of the volumes.

    Zero where one of the volumes was not seen.
    """
    mesh = torch.meshgrid(*places, indexing="ij")
    value, slope, seen = images.sample(
        [torch.stack([place - part / 2, place + part / 2]) for place, part in zip(mesh, d)]
    )
    slope = slope.mean(1)
    shift = (slope * d).sum(0) - (value[1] - value[0])
    rows = [slope[a] * slope[b] for a, b in _PAIRS]
    rows += [*(slope * shift), shift**2, *value, *value**2, value[0] * value[1]]
    return torch.stack([*rows, torch.ones_like(shift)]) * seen.all(0)


def _add_moments(moments: dict, fields: torch.Tensor, kernels) -> None:
    """Add to the sums over windows of fields (n, x, z, y) times powers (p, q, r) of the place.

    Of the first six fields up to the second power, of the others up to the first.
    """
    for r in range(3):
        line = (fields if r < 2 else fields[:6]) @ kernels[2][r].T
        for q in range(3 - r):
            plane = kernels[1][q] @ (line if q + r < 2 else line[:6])
            for p in range(3 - q - r):
                part = plane if p + q + r < 2 else plane[:6]
                sums = along_x(part, kernels[0][p]).double()
                moments[p, q, r] = moments.get((p, q, r), 0.0) + sums


def _normal(moments: dict) -> torch.Tensor:
    """Matrix (..., 12, 12) of the affine fit: terms of x first, then of z, then of y."""
    number = {pair: i for i, pair in enumerate(_PAIRS)}
    rows = []
    for a in range(3):
        for first in _TERMS:
            for b in range(3):
                for second in _TERMS:
                    power = tuple(i + j for i, j in zip(first, second))
                    rows.append(moments[power][number[min(a, b), max(a, b)]])
    return torch.stack(rows, -1).unflatten(-1, (12, 12))


def _solved(once, twice, plain, whole, sigma, images) -> _Fit:
    misfit, mean1, mean2, square1, square2, cross, number = plain
    share = number / whole
    number = number.clamp(min=1e-12)
    contrast = (square1 - mean1**2 / number).clamp(min=0) * (square2 - mean2**2 / number).clamp(
        min=0
    )
    scale = contrast.sqrt()
    normal = _normal(once)
    wanted = torch.stack([once[term][6 + a] for a in range(3) for term in _TERMS], -1)
    spread = normal.diagonal(dim1=-2, dim2=-1)
    textured = (scale > 1e-10 * number) & (spread.amin(-1) > 0)
    prior = torch.tensor([0.0, 1, 1, 1] * 3, dtype=spread.dtype, device=spread.device)
    floor = 1e-9 * spread.mean(-1, keepdim=True) + ~textured[..., None]
    normal = normal + torch.diag_embed(prior * images.variance / sigma**2 + floor)
    root = torch.linalg.cholesky(normal)
    unit = torch.eye(12, dtype=spread.dtype, device=spread.device)[:, [0, 4, 8]]
    right = torch.cat([wanted[..., None], unit.expand(*wanted.shape, 3)], -1)
    answer = torch.cholesky_solve(right, root)
    solution, inverse = answer[..., 0], answer[..., 1:]
    left = misfit - (2 * wanted - (normal @ solution[..., None])[..., 0]).mul(solution).sum(-1)
    left = (left / number / images.passed).clamp(min=images.variance)
    covariance = inverse.mT @ _normal(twice) @ inverse * left[..., None, None]
    solution = solution.unflatten(-1, (3, 4)).permute(3, 4, 0, 1, 2)
    return _Fit(
        solution[:, 0],
        solution[:, 1:] / sigma,
        covariance.diagonal(dim1=-2, dim2=-1).permute(3, 0, 1, 2),
        torch.where(textured, (cross - mean1 * mean2 / number) / scale, torch.nan),
        share,
    )


def _laplacian(gradient: torch.Tensor, windows: VolumeWindows) -> torch.Tensor:
    """Of a displacement (3, ...), from its gradient; from one side at the faces."""
    total = torch.zeros_like(gradient[:, 0])
    for axis in range(3):
        if windows.count[axis] > 1:
            total += torch.gradient(gradient[:, axis], dim=1 + axis)[0] / windows.stride
    return total


def _finite(images: Volumes, windows: VolumeWindows) -> torch.Tensor:
    """Windows whose centres are near no non-finite voxel of any volume."""
    at = [windows.centres(axis).round().long() for axis in range(3)]
    return images.usable.all(0)[at[0]][:, at[1]][:, :, at[2]]
