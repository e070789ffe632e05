"""The first displacement of a coarse-to-fine retrieval, by correlation of large windows."""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement, product
from typing import NamedTuple

import torch
from torch.nn.functional import avg_pool3d, pad

from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.cross_correlation import cross_correlation
from lidar_mi.retrieval.correlation.outliers import validated
from lidar_mi.retrieval.images.inpainting import filled_in
from lidar_mi.retrieval.images.spline import Spline
from lidar_mi.retrieval.images.windows import Windows, averaged, separable, working
from lidar_mi.retrieval.symmetric import largest_eigenvalue

# Voxels of shifted volumes that are correlated at once: more do not fit into a core's cache.
_AT_ONCE = 2**17
# Correlation by which smaller windows must surpass larger ones to take their place.
_BETTER = 0.1
# Px; the highest correlation of smaller windows is as often chance.
_SMALLEST = 8


class Grid(NamedTuple):
    """Places one pixel apart that contain the windows' centres: pixels, or half way between.

    offset: of the first place from the first pixel, 0 or 1/2 px.
    like: empty, of the type and device to work in.
    """

    shape: tuple[int, ...]
    offset: float
    like: torch.Tensor

    @classmethod
    def of(cls, windows: Windows, like: torch.Tensor) -> "Grid":
        """The grid of the windows' centres, at every pixel."""
        even = windows.template % 2 == 0
        return cls(tuple(n - even for n in windows.shape), even / 2, like[:0])

    def windows(self, windows: Windows) -> list[torch.Tensor]:
        """Numbers, along each axis of this grid, of the places of the windows' centres."""
        device = self.like.device
        return [
            torch.tensor(windows.starts(axis), device=device) + (windows.template - 1) // 2
            for axis in range(windows.dims)
        ]

    def places(self, rows: slice = slice(None)) -> list[torch.Tensor]:
        """Coordinates (px) along each axis, as they broadcast, of some rows of the first axis."""
        along = [torch.arange(n).to(self.like) + self.offset for n in self.shape]
        along[0] = along[0][rows]
        dims = len(along)
        return [p.reshape(-1, *[1] * (dims - 1 - axis)) for axis, p in enumerate(along)]

    def interpolated(self, values: torch.Tensor, known: list[torch.Tensor]) -> torch.Tensor:
        """Values (fields, ...) at some evenly spaced places, on all, by cubics.

        Places outside take the nearest value.
        """
        weights = [
            _cubic_weights(at.to(self.like), torch.arange(n).to(self.like))
            for n, at in zip(self.shape, known, strict=True)
        ]
        return separable(values.to(self.like), weights)


def first_pass(
    images: Sequence[torch.Tensor], spline: Spline, windows: Windows, grid: Grid
) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacement (components, *grid.shape) by large windows, and where it was replaced.

    Windows without a vector (`whole_pixels`), or that their neighbours contradict, take the
    neighbours' median. Images are also correlated by windows of half and of a quarter of the size.
    They are used where the images, warped by their displacement, correlate better by 0.1: in a
    rotation of 0.3 px per px the texture at the rim of a window of 32 px moves 5 px away from that
    in the middle. It uses the first two images; ``spline`` is band-limited, ``windows`` are those
    of the last pass.
    """
    if windows.dims > 2:
        d, centres = _of_volumes(images, spline, windows)
        return _on_grid(grid, d, centres, continued=True)
    coarse, *smaller = window_sizes(windows)
    d, replaced = _on_grid(grid, *_of_images(images, coarse))
    width = windows.template / 2
    # sheared texture decorrelates in large windows: smaller ones compete with them
    score = _correlation(spline, grid, d, width)
    for size in smaller:
        smaller_d, filled = _on_grid(grid, *_of_images(images, size))
        new_score = _correlation(spline, grid, smaller_d, width)
        better = new_score > score + _BETTER
        d, replaced, score = (
            torch.where(better, new, old)
            for new, old in ((smaller_d, d), (filled, replaced), (new_score, score))
        )
    return d, replaced


def window_sizes(windows: Windows) -> list[Windows]:
    """Windows of images from large to small, all of the same range but for the largest."""
    sizes = [coarse_windows(windows)]
    for template in (windows.template, windows.template // 2):
        if _SMALLEST <= template < sizes[-1].template:
            search = windows.search - windows.template + template
            sizes.append(Windows(windows.shape, template, search, max(1, template // 2)))
    return sizes


def _on_grid(
    grid: Grid, d: torch.Tensor, centres: list[torch.Tensor], continued: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Vectors at some centres, validated, on the whole grid, and where they were replaced."""
    d, wrong = validated(d, 1, continued=continued)
    known = [at.to(grid.like) - grid.offset for at in centres]
    replaced = grid.interpolated(wrong[None].to(d), known)[0] > 0.5
    return grid.interpolated(d, known), replaced


def _correlation(spline: Spline, grid: Grid, d: torch.Tensor, width: float) -> torch.Tensor:
    """Correlation, over Gaussians, of two images that are warped to mid-time by displacements."""
    places = [
        torch.stack([p - part / 2, p + part / 2]) for p, part in zip(grid.places(), d, strict=True)
    ]
    inside = spline.holds(*places).all(0)
    first, second = spline._replace(coefficients=spline.coefficients[:2]).sample(*places)[0]
    mean1, mean2, square1, square2, cross = (
        averaged(field, inside, width)
        for field in (first, second, first**2, second**2, first * second)
    )
    contrast = (square1 - mean1**2) * (square2 - mean2**2)
    # without texture rounding may leave a negative variance
    return (cross - mean1 * mean2) / contrast.clamp(min=1e-12 * float(contrast.abs().max())).sqrt()


def coarse_windows(windows: Windows) -> Windows:
    """Windows of images twice as large over twice the range, where they fit into the image."""
    double = 2 if min(windows.shape) >= 2 * windows.search else 1
    template, search = double * windows.template, double * windows.search
    return Windows(windows.shape, template, search, max(1, template // 2))


def _of_images(
    images: Sequence[torch.Tensor], windows: Windows
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Displacements of windows of images, see `whole_pixels`, and their centres."""
    d = whole_pixels(images[0], images[1], windows)
    return d, [windows.centres(axis).to(d.device) for axis in (0, 1)]


def whole_pixels(image1: torch.Tensor, image2: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Displacements (2, rows, columns) of windows of images, px, at least to whole pixels.

    Pixels that are not finite have smooth values (`inpainting.inpainted`). NaN where the
    correlation is flagged, and where more than half of a template of image 1 or of a search region
    of image 2 is not finite.
    """
    known1, known2 = (working(torch.isfinite(image)) for image in (image1, image2))
    sizes = windows.template, windows.search, windows.stride
    displacement = cross_correlation(filled_in(image1), filled_in(image2), *sizes)
    usable = (displacement.flag == 0) | (displacement.flag == Flag.NO_SUBPIXEL_FIT.value)
    usable &= (windows.of_templates(known1) >= 0.5) & (windows.of_regions(known2) >= 0.5)
    return torch.where(usable, displacement.d, torch.nan)


def _of_volumes(
    images: Sequence[torch.Tensor], spline: Spline, windows: Windows
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Windows about twice as large, as far as they fit into the volume, over the same range.

    Normalised cross-correlation of volumes averaged over 2 x 2 x 2 voxels at all whole shifts, and
    the top of a quadratic through the peak and its 26 neighbours. NaN where the peak lies on the
    rim of the search.
    """
    finite = torch.stack([torch.isfinite(image) for image in images[:2]])
    scores, centres = volume_scores(coarse_volumes(spline, finite), windows)
    d = 2 * _peaks(scores, max(1, round(windows.reach / 2)))
    return d, [at.to(d.device) for at in centres]


def coarse_volumes(spline: Spline, finite: torch.Tensor) -> torch.Tensor:
    """Two volumes averaged over 2 x 2 x 2 voxels, those not finite being 0."""
    axes = [torch.arange(n).to(spline.coefficients) for n in spline.shape]
    whole = [place.expand(2, *place.shape) for place in torch.meshgrid(*axes, indexing="ij")]
    return avg_pool3d((spline.sample(*whole)[0] * finite)[:, None], 2)[:, 0]


def volume_scores(
    values: torch.Tensor, windows: Windows
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Correlation (shifts, ...) of windows of averaged volumes, and their centres in voxels.

    NaN where volume 1 has no contrast, -1 where too little overlaps.
    """
    shape = tuple(values.shape[1:])
    reach = max(1, round(windows.reach / 2))
    size = [min(windows.template, n) for n in shape]
    step = max(1, windows.template // 2)

    def sums(field: torch.Tensor) -> torch.Tensor:
        return avg_pool3d(field[:, None], size, step)[:, 0]

    first, second = values
    fields = pad(torch.stack([second, second**2, torch.ones_like(first)]), (reach,) * 6)
    for axis, n in enumerate(shape, start=1):
        fields = fields.unfold(axis, n, 1)  # a view: (3, *shifts, *shape)
    contrast1 = (sums((first**2)[None]) - sums(first[None]) ** 2)[0]
    shifts = torch.cartesian_prod(*[torch.arange(2 * reach + 1)] * 3)
    scores = []
    for chunk in shifts.split(max(1, _AT_ONCE // first.numel())):
        moved = fields[:, *chunk.T]
        inside = sums(moved[2])
        # the part of image 1 that is compared
        parts = [moved[0], moved[1], first * moved[0], first * moved[2], first**2 * moved[2]]
        mean2, square2, cross, mean1, square1 = (sums(part) / inside for part in parts)
        contrast = (square1 - mean1**2) * (square2 - mean2**2)
        score = (cross - mean1 * mean2) / contrast.clamp(min=1e-12).sqrt()
        # at least half of a window must overlap
        scores.append(torch.where(inside > 0.5, score, -1.0))
    whole = torch.where(contrast1 > 1e-10, torch.cat(scores), torch.nan)
    centres = [
        n - 0.5 + 2 * step * torch.arange(m) for n, m in zip(size, whole.shape[1:], strict=True)
    ]
    return whole, centres


def _peaks(scores: torch.Tensor, reach: int) -> torch.Tensor:
    """Place (3, ...) of the highest of scores over the shifts, between shifts; NaN on the rim."""
    side = 2 * reach + 1
    flat = scores.nan_to_num(-2.0).reshape(len(scores), -1)
    best = flat.argmax(0)
    place = torch.stack([best // side**2, best // side % side, best % side])
    rim = ((place == 0) | (place == side - 1)).any(0)
    # values about a peak as a + b x + x' C x / 2: least squares over the 27 places
    around = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=3))).to(flat)
    pairs = list(combinations_with_replacement(range(3), 2))
    squares = [around[:, a] * around[:, b] / (1 + (a == b)) for a, b in pairs]
    quadratic = torch.linalg.pinv(
        torch.cat([torch.ones_like(around[:, :1]), around, torch.stack(squares, 1)], 1)
    )
    # inner places, which have all 26 neighbours
    number = (around.long()[:, :, None] + place.clamp(1, side - 2)).unbind(1)
    terms = quadratic @ flat.gather(0, (number[0] * side + number[1]) * side + number[2])
    slope = terms[1:4].T
    curvature = slope.new_zeros(len(slope), 3, 3)
    for (a, b), term in zip(pairs, terms[4:], strict=True):
        curvature[:, a, b] = curvature[:, b, a] = term
    peaked = largest_eigenvalue(curvature) < 0
    # a saddle has no maximum: its offset is 0
    curvature = torch.where(peaked[:, None, None], curvature, -torch.eye(3).to(curvature))
    offset = -torch.linalg.solve(curvature, slope[..., None])[..., 0]
    # the quadratic holds between neighbours only
    offset = torch.where((peaked & (offset.abs() < 1).all(1))[:, None], offset, 0.0).T
    d = torch.where(rim | ~(flat.amax(0) > -1), torch.nan, place - reach + offset)
    return d.reshape(3, *scores.shape[1:])


def _cubic_weights(known: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Matrix (place, known) of cubic convolution (a = -3/4; Keys 1981, IEEE ASSP 29, 1153-1160)."""
    matrix = places.new_zeros(len(places), len(known))
    step = float(known[1] - known[0]) if len(known) > 1 else math.inf
    at = (places - known[0]) / step
    low = at.floor()
    for shift in (-1, 0, 1, 2):
        x = (at - low - shift).abs()
        inner = (1.25 * x - 2.25) * x * x + 1
        outer = ((-0.75 * x + 3.75) * x - 6.0) * x + 3.0
        weight = torch.where(x <= 1, inner, outer)
        # constant beyond the ends
        column = (low.long() + shift).clamp(0, len(known) - 1)
        matrix.scatter_add_(1, column[:, None], weight[:, None])
    return matrix
