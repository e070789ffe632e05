"""Binned images of rings: means over sectors of annuli of equal width in r^2.

An etalon's order decreases linearly with r^2 (to 1e-4 on a camera), so annuli of equal steps in r^2
are equal steps in order: every ring has the same number of them. Sectors keep the direction, from
which the centre follows. A cell stores first and second moments of its pixels' positions about the
centre it was made with. About any other centre its mean r^2 is then exact, and the spread of r^2
exact up to third moments. So an image is binned only once, although a fit moves the centre, as long
as it moves by a few pixels.

Positions are those in the ideal image (`lidar_mi.retrieval.rings.geometry`), pixels count with
their response to light, and those of response 0 (hot, dead, covered) do not count at all.
"""

import math
from dataclasses import dataclass

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.geometry import Geometry, straightened
from lidar_mi.retrieval.rings.smooth import term_values
from lidar_mi.retrieval.threads import mapped

# Images that a thread adds up at once.
_AT_ONCE = 8


@dataclass(frozen=True, eq=False)
class Cells:
    """Groups of pixels, tensors of shape (cells,), float64; pixels, x right, y down.

    index: cell of every pixel, row by row; None where every pixel is a cell of its own.
    count: sum of the responses of the cell's pixels: their number where all are 1.
    centre: origin of x, y and r2: (x, y) from the top left pixel's centre.
    x, y, r2: means over the cell's pixels.
    spread (shape (cells, 3, 3), or None): covariance of (x, y, r2) over the cell's pixels.
    terms (cells, names): means of the smooth terms that were asked for.
    """

    index: torch.Tensor | None
    count: torch.Tensor
    centre: tuple[float, float]
    x: torch.Tensor
    y: torch.Tensor
    r2: torch.Tensor
    spread: torch.Tensor | None
    terms: torch.Tensor

    def part(self, which: slice) -> "Cells":
        """Some of the cells, without their pixels."""
        spread = None if self.spread is None else self.spread[which]
        return Cells(
            None,
            self.count[which],
            self.centre,
            self.x[which],
            self.y[which],
            self.r2[which],
            spread,
            self.terms[which],
        )

    def means(self, images: torch.Tensor) -> torch.Tensor:
        """Mean of every cell: images (..., height, width) to (..., cells)."""
        flat = images.flatten(-2)
        if self.index is None:
            return flat.double()
        # pixels that do not count have the index after the last cell
        sums = flat.new_zeros((*flat.shape[:-1], len(self.count) + 1))
        parts = (whole.view(-1, whole.shape[-1]).split(_AT_ONCE) for whole in (sums, flat))

        index = self.index

        def add(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
            # half of the time of index_add_
            pair[0].scatter_add_(-1, index.expand_as(pair[1]), pair[1])

        mapped(add, zip(*parts, strict=True))
        return sums[..., :-1].double() / self.count


def pixels(
    shape: tuple[int, int],
    centre: tuple[float, float],
    device: str | torch.device = "cpu",
    *,
    geometry: Geometry | None = None,
    names: tuple[str, ...] = (),
) -> Cells:
    """Every pixel of an image of (height, width) as a cell of its own."""
    x, y, terms = _positions(shape, centre, device, geometry, names)
    return Cells(None, torch.ones_like(x), centre, x, y, x**2 + y**2, None, terms)


def annular_sectors(
    shape: tuple[int, int],
    centre: tuple[float, float],
    step: float,
    sectors: int = 16,
    device: str | torch.device = "cpu",
    *,
    geometry: Geometry | None = None,
    response: torch.Tensor | None = None,
    names: tuple[str, ...] = (),
) -> Cells:
    """Sectors of annuli about ``centre``, ``step`` px^2 wide in r^2.

    shape: height and width of the images, pixels.
    centre: (x, y), pixels; may lie outside.
    step: px^2. Binning loses (2 pi n step / order)^2 / 12 of the information of the n-th harmonic
        of the ring profile, with `order` the step of r^2 from ring to ring.
    sectors: per turn; 1 for whole annuli.
    geometry: of the camera; ideal if not given.
    response (height, width): of every pixel to light, 1 on average; 0 leaves a pixel out.
    names: smooth terms to average, see `lidar_mi.retrieval.rings.smooth.term_names`.

    Raises InputError: a step or number of sectors that is not above 0, a response that is negative
    or 0 all over.
    """
    if not (math.isfinite(step) and step > 0):
        raise InputError(f"step: {step!r} px^2 is not allowed; expected above 0")
    if sectors < 1:
        raise InputError(f"sectors: {sectors!r} is not allowed; expected 1 or more")
    x, y, terms = _positions(shape, centre, device, geometry, names)
    weight = torch.ones_like(x) if response is None else response.to(x).flatten()
    if response is not None and (
        len(weight) != len(x) or not ((weight >= 0).all() and weight.any())
    ):
        raise InputError(
            f"response: shape {tuple(response.shape)}, {float(weight.min()):g} to "
            f"{float(weight.max()):g} is not allowed; expected {shape[0]} x {shape[1]} px of 0 or "
            "more"
        )
    r2 = x**2 + y**2
    azimuth = (torch.atan2(y, x) / (2 * torch.pi) + 0.5) * sectors
    label = (r2 / step).long() * sectors + azimuth.long().clamp(max=sectors - 1)
    # numbered in the order of the labels; pixels that do not count come last
    used = torch.zeros(int(label.max()) + 1, dtype=torch.long, device=label.device)
    used[label[weight > 0]] = 1
    size = int(used.sum())
    index = torch.where(weight > 0, (used.cumsum(0) - 1)[label], size)
    count = _sums(index, weight, size)

    def mean(values: torch.Tensor) -> torch.Tensor:
        return _sums(index, weight * values, size) / count

    mean_x, mean_y, mean_r2 = means = [mean(values) for values in (x, y, r2)]
    inner = index.clamp(max=size - 1)
    off = [values - middle[inner] for values, middle in zip((x, y, r2), means, strict=True)]
    spread = torch.stack([torch.stack([mean(a * b) for a in off], -1) for b in off], -1)
    smooth = (
        torch.stack([mean(values) for values in terms.T], 1) if names else count[:, None][:, :0]
    )
    return Cells(index, count, centre, mean_x, mean_y, mean_r2, spread, smooth)


def _sums(index: torch.Tensor, values: torch.Tensor, size: int) -> torch.Tensor:
    """Sum of the values of each cell, without those that do not count."""
    total = torch.zeros(size + 1, dtype=torch.float64, device=values.device)
    return total.index_add_(0, index, values)[:size]


def _positions(
    shape: tuple[int, int],
    centre: tuple[float, float],
    device: str | torch.device,
    geometry: Geometry | None,
    names: tuple[str, ...],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Positions of all pixels from the centre in the ideal image, and their smooth terms."""
    rows, columns = (torch.arange(size, dtype=torch.float64, device=device) for size in shape)
    x, y = (part.flatten() for part in torch.broadcast_tensors(columns[None, :], rows[:, None]))
    half = math.hypot(*shape) / 2
    middle = [(size - 1) / 2 for size in shape]
    terms = term_values(names, (x - middle[1]) / half, (y - middle[0]) / half)
    if geometry is not None:
        x, y = straightened(geometry, x, y)
    return x - centre[0], y - centre[1], terms
