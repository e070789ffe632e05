"""Where the windows lie: templates in image 1, search regions in image 2, sums over both."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError

# Working memory of one tile of windows. Small enough to stay near the cache, large enough that
# the cost of a call does not matter.
TILE_BYTES = 1 << 27


class Tile(NamedTuple):
    """A block of windows and the pixels it needs; as an image of its own it has just these."""

    vectors: tuple[slice, slice]
    pixels: tuple[slice, slice]


@dataclass(frozen=True)
class Windows:
    """Square templates and search regions on an image, both stepped by `stride` pixels.

    A template of `template` pixels lies in the middle of its search region of `search` pixels,
    which lies wholly inside the image. Candidates are all templates inside the region, at
    integer shifts -lead ... search - template - lead with lead = (search - template) // 2: where
    search - template is odd, there is one more shift on the positive side.

    Attributes
    ----------
    shape : (int, int)
        Image size in pixels, (z, y).
    template, search, stride : int
        In pixels; template >= 2, search >= template + 2, stride >= 1.

    Raises
    ------
    InputError
        A size out of its range, or an image smaller than the search region.
    """

    shape: tuple[int, int]
    template: int = 8
    search: int = 16
    stride: int = 1

    def __post_init__(self) -> None:
        lowest = {"template": 2, "search": self.template + 2, "stride": 1}
        for name, low in lowest.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                allowed = "template + 2" if name == "search" else low
                raise InputError(f"{name}: {value!r} px is not an integer >= {allowed}")
        if min(self.shape) < self.search:
            raise InputError(
                f"search: {self.search} px does not fit into the image of "
                f"{self.shape[0]} x {self.shape[1]} (z x y) px"
            )

    @property
    def lead(self) -> int:
        """Pixels from the start of a search region to the start of its template."""
        return (self.search - self.template) // 2

    @property
    def shifts(self) -> int:
        """Number of candidate positions in each direction."""
        return self.search - self.template + 1

    @property
    def count(self) -> tuple[int, int]:
        """Number of windows, (z, y)."""
        rows, columns = ((size - self.search) // self.stride + 1 for size in self.shape)
        return rows, columns

    @property
    def pixels(self) -> tuple[slice, slice]:
        """The part of the image that the search regions cover: a stride may leave a margin."""
        rows, columns = (slice((n - 1) * self.stride + self.search) for n in self.count)
        return rows, columns

    def starts(self, axis: int) -> range:
        """First pixel of the templates along `axis` (0 = z, 1 = y)."""
        return range(self.lead, self.lead + self.count[axis] * self.stride, self.stride)

    def unravel(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Shift in z and in y (px) of candidate number `index`, and whether it is on the rim."""
        row, column = index // self.shifts, index % self.shifts
        last = self.shifts - 1
        rim = (row == 0) | (row == last) | (column == 0) | (column == last)
        return row - self.lead, column - self.lead, rim

    def tiles(self, bytes_per_window: int) -> Iterator[Tile]:
        """Cut the windows into blocks of at most TILE_BYTES (but at least one window)."""
        rows, columns = self.count
        room = max(1, TILE_BYTES // bytes_per_window)
        width = min(columns, room)
        height = max(1, room // width)
        for top in range(0, rows, height):
            for left in range(0, columns, width):
                vectors = (
                    slice(top, min(top + height, rows)),
                    slice(left, min(left + width, columns)),
                )
                pixels = tuple(
                    slice(s.start * self.stride, (s.stop - 1) * self.stride + self.search)
                    for s in vectors
                )
                yield Tile(vectors, pixels)

    def of_templates(self, pixels: torch.Tensor) -> torch.Tensor:
        """Mean of an image over every template, shape (..., *count)."""
        for axis in (-2, -1):
            size = self.shape[axis] - self.search + self.template
            pixels = pixels.narrow(axis, self.lead, size)
            pixels = strided(box_sum(pixels, self.template, axis), self.stride, axis)
        return pixels / self.template**2

    def of_regions(self, pixels: torch.Tensor) -> torch.Tensor:
        """Mean of an image over every search region, shape (..., *count)."""
        for axis in (-2, -1):
            pixels = strided(box_sum(pixels, self.search, axis), self.stride, axis)
        return pixels / self.search**2


def box_sum(values: torch.Tensor, size: int, axis: int) -> torch.Tensor:
    """Sum of `size` neighbours along `axis`, at every position where they all exist.

    Built by doubling (pairs, fours, eights, ...): log2(size) additions a value, and unlike a
    running sum its rounding error does not grow along the image and a NaN stays in its windows.
    """
    length = values.shape[axis] - size + 1
    total, offset, width = None, 0, 1
    while True:
        if size & width:
            part = values.narrow(axis, offset, length)
            total = part if total is None else total + part
            offset += width
        if 2 * width > size:
            return total
        kept = values.shape[axis] - width
        values = values.narrow(axis, 0, kept) + values.narrow(axis, width, kept)
        width *= 2


def strided(values: torch.Tensor, stride: int, axis: int) -> torch.Tensor:
    """Every `stride`-th value along `axis`, a view."""
    return values if stride == 1 else values.unfold(axis, 1, stride).squeeze(-1)


def candidates(values: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Value of every candidate of every window, a view of shape (shifts, shifts, *count).

    `values` holds one number per n x n box of the image, by the box's first pixel.
    """
    n = windows.shifts
    return values.unfold(0, n, windows.stride).unfold(1, n, windows.stride).permute(2, 3, 0, 1)


def image_pair(image1: torch.Tensor, image2: torch.Tensor) -> None:
    """Check that two tensors are images of one size.

    Raises
    ------
    InputError
        Not two-dimensional, of different size or device, or not real numbers.
    """
    for name, image in (("image1", image1), ("image2", image2)):
        if not isinstance(image, torch.Tensor):
            raise InputError(f"{name}: {type(image).__name__} is not a torch.Tensor")
        if image.ndim != 2:
            raise InputError(f"{name}: shape {tuple(image.shape)} is not two-dimensional (z, y)")
        if image.is_complex() or image.dtype == torch.bool:
            raise InputError(f"{name}: values of {image.dtype} are not real numbers")
    if image1.shape != image2.shape:
        sizes = " and ".join(f"{i.shape[0]} x {i.shape[1]}" for i in (image1, image2))
        raise InputError(f"image2: sizes {sizes} px (z x y) differ; both images must have one grid")
    if image1.device != image2.device:
        raise InputError(f"image2: on {image2.device}, but image1 is on {image1.device}")


def working(image: torch.Tensor) -> torch.Tensor:
    """The image in the precision all sums are made in: float64 (float32 where there is none).

    Variances come out as differences of sums, which float32 spoils where the contrast of a
    window is below 1e-3 of the distance between its mean and the image's. float64 adds about a
    third to the time of a full scan.
    """
    return image.to(torch.float32 if image.device.type == "mps" else torch.float64)
