"""Positions of the windows: templates in image 1, search regions in image 2, sums over both."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import NamedTuple

import torch
from torch.nn.functional import pad

from lidar_mi.errors import InputError
from lidar_mi.retrieval.device import divisor
from lidar_mi.retrieval.images.window_sizes import check_window_sizes

# Working memory of one tile of windows. Small enough to stay near the cache, large enough that
# the cost of a call is negligible.
TILE_BYTES = 1 << 27
# Windows summed at once: more waste products with zeros, fewer are too small to be fast.
_BLOCK = 48
# Longest side (px) of fields whose Gaussian sums are products with whole matrices: at 400 px they
# take as long as those in blocks, at 200 px a third of it.
_WHOLE = 320


def tile_bytes() -> int:
    """Working memory of one tile: `TILE_BYTES`, or less where a device has less."""
    return TILE_BYTES // divisor()


class Tile(NamedTuple):
    """A block of windows and the pixels it needs."""

    vectors: tuple[slice, slice]
    pixels: tuple[slice, slice]


@dataclass(frozen=True)
class Windows:
    """Templates and search regions on an image or a volume, both stepped by `stride` pixels.

    A template of `template` pixels a side lies in the middle of its search region of `search`
    pixels. Candidates are all templates inside the region, at integer shifts
    -lead ... search - template - lead with lead = (search - template) // 2: where
    search - template is odd, there is one more shift on the positive side.

    In an image the search regions lie wholly inside. In a volume, which is thin, the templates do,
    and the margin that the stride leaves is divided equally between both faces.

    shape: size in pixels: (z, y) of an image, (x, z, y) of a volume.
    template, search, stride: in pixels; template >= 2 (volumes: 4), search >= template + 2, stride
        >= 1.

    Raises InputError: a size out of its range, an image smaller than the search region, a volume
    smaller than a template.
    """

    shape: tuple[int, ...]
    template: int = 8
    search: int = 16
    stride: int = 1

    def __post_init__(self) -> None:
        check_window_sizes(self.shape, self.template, self.search, self.stride)

    @property
    def dims(self) -> int:
        """2 of an image, 3 of a volume."""
        return len(self.shape)

    @property
    def inner(self) -> int:
        """Side of the window that lies wholly inside: search region, of a volume the template."""
        return self.search if self.dims == 2 else self.template

    @property
    def lead(self) -> int:
        """Pixels from the start of a search region to the start of its template."""
        return (self.search - self.template) // 2

    @property
    def reach(self) -> float:
        """Largest displacement searched in each direction, px."""
        return (self.search - self.template) / 2

    @property
    def shifts(self) -> int:
        """Number of candidate positions in each direction."""
        return self.search - self.template + 1

    @property
    def count(self) -> tuple[int, ...]:
        """Number of windows along each axis."""
        return tuple((size - self.inner) // self.stride + 1 for size in self.shape)

    @property
    def pixels(self) -> tuple[slice, ...]:
        """The part of the image that the search regions cover: a stride may leave a margin."""
        return tuple(slice((n - 1) * self.stride + self.search) for n in self.count)

    def starts(self, axis: int) -> range:
        """First pixel of the templates along an axis."""
        n = self.count[axis]
        first = self.lead
        if self.dims > 2:
            first = (self.shape[axis] - self.template - (n - 1) * self.stride) // 2
        return range(first, first + n * self.stride, self.stride)

    def centres(self, axis: int) -> torch.Tensor:
        """Middles of the templates along an axis, px from the first pixel."""
        return torch.tensor(self.starts(axis), dtype=torch.float64) + (self.template - 1) / 2

    def unravel(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Shift in z and in y (px) of candidate number `index`, and whether it is on the rim."""
        row, column = index // self.shifts, index % self.shifts
        last = self.shifts - 1
        rim = (row == 0) | (row == last) | (column == 0) | (column == last)
        return row - self.lead, column - self.lead, rim

    def tiles(self, bytes_per_window: int) -> Iterator[Tile]:
        """The windows of an image in blocks of at most `tile_bytes` (but at least one window)."""
        rows, columns = self.count
        most = max(1, tile_bytes() // bytes_per_window)
        width = min(columns, most)
        height = max(1, most // width)
        for top in range(0, rows, height):
            for left in range(0, columns, width):
                vectors = (
                    slice(top, min(top + height, rows)),
                    slice(left, min(left + width, columns)),
                )
                yield Tile(vectors, (self._searched(vectors[0]), self._searched(vectors[1])))

    def _searched(self, vectors: slice) -> slice:
        """Pixels along an axis in the search regions of some windows of an image."""
        return slice(vectors.start * self.stride, (vectors.stop - 1) * self.stride + self.search)

    def of_templates(self, pixels: torch.Tensor) -> torch.Tensor:
        """Mean of an image over every template, shape (..., *count)."""
        for axis, n in enumerate(self.count):
            start, axis = self.starts(axis).start, axis - self.dims
            pixels = pixels.narrow(axis, start, (n - 1) * self.stride + self.template)
            pixels = strided(box_sum(pixels, self.template, axis), self.stride, axis)
        return pixels / self.template**self.dims

    def of_centres(self, pixels: torch.Tensor) -> torch.Tensor:
        """Mean of an image over the middle pixel of every template, or the middle 2 x 2."""
        side = 2 - self.template % 2
        for axis, n in enumerate(self.count):
            start, axis = self.starts(axis).start + (self.template - 1) // 2, axis - self.dims
            pixels = pixels.narrow(axis, start, (n - 1) * self.stride + side)
            pixels = strided(box_sum(pixels, side, axis), self.stride, axis)
        return pixels / side**self.dims

    def of_regions(self, pixels: torch.Tensor) -> torch.Tensor:
        """Mean of an image over every search region, of a volume over every template."""
        if self.inner == self.template:
            return self.of_templates(pixels)
        for axis in range(-self.dims, 0):
            pixels = strided(box_sum(pixels, self.search, axis), self.stride, axis)
        return pixels / self.search**self.dims


def box_sum(values: torch.Tensor, size: int, axis: int) -> torch.Tensor:
    """Sum of `size` neighbours along `axis`, at every position where they all exist.

    Built by doubling (pairs, fours, eights, ...): log2(size) additions per value, and unlike a
    running sum its rounding error does not grow along the image and a NaN stays in its windows.
    """
    length = values.shape[axis] - size + 1
    parts: list[torch.Tensor] = []
    offset, width = 0, 1
    while True:
        if size & width:
            parts.append(values.narrow(axis, offset, length))
            offset += width
        if 2 * width > size:
            return reduce(torch.add, parts)
        whole = values.shape[axis] - width
        values = values.narrow(axis, 0, whole) + values.narrow(axis, width, whole)
        width *= 2


def window_sums(
    fields: torch.Tensor, kernels: Sequence[torch.Tensor], step: int, axis: int
) -> torch.Tensor:
    """Sums (kernels, n, ...) along an axis of fields (n, ...), weighted by each of several kernels.

    Sums start every `step` values, where the kernel lies wholly inside. Blocks of values are
    multiplied with all kernels at once, which takes 10 % of the time of a convolution.
    """
    taps = len(kernels[0])
    fields = fields.movedim(axis, -1)
    number = (fields.shape[-1] - taps) // step + 1
    block = min(number, max(1, _BLOCK // step))
    blocks = -(-number // block)
    length = (block - 1) * step + taps
    fields = pad(fields, (0, max(0, (blocks - 1) * block * step + length - fields.shape[-1])))
    place = torch.arange(length, device=fields.device)[:, None]
    place = place - step * torch.arange(block, device=fields.device)
    inside = (place >= 0) & (place < taps)
    weights = torch.stack(list(kernels))[:, place.clamp(0, taps - 1)] * inside
    pieces = fields.unfold(-1, length, block * step)
    sums = pieces.reshape(1, -1, length) @ weights
    sums = sums.reshape(len(kernels), *fields.shape[:-1], blocks * block)[..., :number]
    return sums.movedim(-1, axis + 1)


def averaged(field: torch.Tensor, known: torch.Tensor, width: float) -> torch.Tensor:
    """Gaussian mean of a field where it is known; the mean of all of it where nothing is near."""
    fields = torch.stack([torch.where(known, field, 0.0), known.to(field)])
    total, number = _gaussian_sums(fields, width)
    mean = fields[0].sum() / fields[1].sum().clamp(min=1)
    return torch.where(number > 1e-3, total / number.clamp(min=1e-3), mean)


def _gaussian_sums(fields: torch.Tensor, width: float) -> torch.Tensor:
    """Sums of fields (n, ...) about each pixel, weighted by a Gaussian up to three widths."""
    reach = math.ceil(3 * width)
    dtype, device = fields.dtype, fields.device
    if max(fields.shape[1:]) <= _WHOLE:
        along = [_gaussians(n, width, reach, dtype, device) for n in fields.shape[1:]]
        return separable(fields, along)
    place = torch.arange(-reach, reach + 1, dtype=dtype, device=device)
    gaussian = torch.exp(-(place / width).square() / 2)
    for axis in range(1, fields.ndim):
        rim = [0, 0] * (fields.ndim - 1 - axis) + [reach, reach]
        fields = window_sums(pad(fields, rim), [gaussian], 1, axis)[0]
    return fields


@lru_cache(maxsize=16)
def _gaussians(
    n: int, width: float, reach: int, dtype: torch.dtype, device: torch.device
) -> torch.Tensor:
    """Weights (n, n) of the pixels along an axis about each of them."""
    place = torch.arange(n, dtype=dtype, device=device)
    separation = place[:, None] - place
    return torch.exp(-(separation / width).square() / 2) * (separation.abs() <= reach)


def separable(values: torch.Tensor, matrices: Sequence[torch.Tensor]) -> torch.Tensor:
    """A matrix (new, old) along each of the last axes, as many as there are matrices."""
    dims = len(matrices)
    for axis, matrix in enumerate(matrices, -dims):
        if axis == -1:
            values = values @ matrix.T
        elif axis == -2:
            values = matrix @ values
        else:
            shape = values.shape[axis + 1 :]
            values = (matrix @ values.flatten(axis + 1)).unflatten(-1, shape)
    return values


def linear_weights(known: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Matrix (place, known) of linear interpolation; the outermost value holds outside."""
    if len(known) == 1:
        return places.new_ones(len(places), 1)
    at = ((places - known[0]) / (known[1] - known[0])).clamp(0, len(known) - 1)
    number = torch.arange(len(known), dtype=places.dtype, device=places.device)
    return (1 - (at[:, None] - number).abs()).clamp(min=0)


def strided(values: torch.Tensor, stride: int, axis: int) -> torch.Tensor:
    """Every `stride`-th value along `axis`, a view."""
    return values if stride == 1 else values.unfold(axis, 1, stride).squeeze(-1)


def candidates(values: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Value of every candidate of every window, a view of shape (shifts, shifts, *count).

    `values` holds one number per n x n box of the image, by the box's first pixel.
    """
    n = windows.shifts
    return values.unfold(0, n, windows.stride).unfold(1, n, windows.stride).permute(2, 3, 0, 1)


def image_pair(image1: torch.Tensor, image2: torch.Tensor, dims: Sequence[int] = (2,)) -> None:
    """Check that two tensors are images (of 2 dimensions) or volumes (of 3) of one size.

    Raises InputError: of other numbers of dimensions than `dims`, of different size or device, or
    not real numbers.
    """
    for name, image in (("image1", image1), ("image2", image2)):
        if not isinstance(image, torch.Tensor):
            raise InputError(f"{name}: {type(image).__name__} is not a torch.Tensor")
        if image.ndim not in dims:
            allowed = " or ".join(("(z, y)", "(x, z, y)")[n - 2] for n in dims)
            raise InputError(f"{name}: shape {tuple(image.shape)} is not {allowed}")
        if image.is_complex() or image.dtype == torch.bool:
            raise InputError(f"{name}: values of {image.dtype} are not real numbers")
    if image1.shape != image2.shape:
        sizes = " and ".join(" x ".join(map(str, i.shape)) for i in (image1, image2))
        axes = "z x y" if image1.ndim == 2 else "x, z, y"
        raise InputError(
            f"image2: sizes {sizes} px ({axes}) differ; both images must have one grid"
        )
    if image1.device != image2.device:
        raise InputError(f"image2: on {image2.device}, but image1 is on {image1.device}")


def working(image: torch.Tensor) -> torch.Tensor:
    """The image in the precision of all sums: float64 (float32 where there is none).

    Variances are differences of sums, for which float32 is too coarse where the contrast of a
    window is below 1e-3 of the difference between its mean and the image's. float64 takes about
    30 % more time for a full scan.
    """
    return image.to(torch.float32 if image.device.type == "mps" else torch.float64)


def stored(image: torch.Tensor) -> torch.Tensor:
    """An image as `working`, a volume in float32, which suffices once its mean is subtracted."""
    return working(image) if image.ndim == 2 else image.float()
