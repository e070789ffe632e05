"""Binned images of rings: means over sectors of annuli of equal width in r^2.

An etalon's order decreases linearly with r^2 (to 1e-4 on a camera), so annuli of equal steps in r^2
are equal steps in order: every ring has the same number of them. Sectors keep the direction, from
which the centre follows. A cell stores first and second moments of its pixels' positions about the
centre it was made with. About any other centre its mean r^2 is then exact, and the spread of r^2
exact up to third moments. So an image is binned only once, although a fit moves the centre, as long
as it moves by a few pixels.
"""

import math
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError


class Cells(NamedTuple):
    """Groups of pixels, tensors of shape (cells,), float64; pixels, x right, y down.

    Attributes
    ----------
    index : torch.Tensor or None
        Cell of every pixel, row by row; None where every pixel is a cell of its own.
    count : torch.Tensor
        Pixels in the cell.
    centre : (float, float)
        Origin of x, y and r2: (x, y) from the top left pixel's centre.
    x, y, r2 : torch.Tensor
        Means over the cell's pixels.
    spread : torch.Tensor, shape (cells, 3, 3), or None
        Covariance of (x, y, r2) over the cell's pixels.
    """

    index: torch.Tensor | None
    count: torch.Tensor
    centre: tuple[float, float]
    x: torch.Tensor
    y: torch.Tensor
    r2: torch.Tensor
    spread: torch.Tensor | None

    def means(self, images: torch.Tensor) -> torch.Tensor:
        """Mean of every cell: images (..., height, width) to (..., cells)."""
        flat = images.flatten(-2)
        if self.index is None:
            return flat.double()
        sums = flat.new_zeros((*flat.shape[:-1], len(self.count)))
        # one image at a time: four times faster than a sum along the last axis of all
        for total, image in zip(
            sums.view(-1, sums.shape[-1]), flat.view(-1, flat.shape[-1]), strict=True
        ):
            total.index_add_(0, self.index, image)
        return sums.double() / self.count


def pixels(shape: tuple[int, int], centre: tuple[float, float], device="cpu") -> Cells:
    """Every pixel of an image of (height, width) as a cell of its own."""
    x, y = (values.flatten() for values in _positions(shape, centre, device))
    return Cells(None, torch.ones_like(x), centre, x, y, x**2 + y**2, None)


def annular_sectors(
    shape: tuple[int, int],
    centre: tuple[float, float],
    step: float,
    sectors: int = 16,
    device="cpu",
) -> Cells:
    """Sectors of annuli about ``centre``, ``step`` px^2 wide in r^2.

    Parameters
    ----------
    shape : (int, int)
        Height and width of the images, pixels.
    centre : (float, float)
        (x, y), pixels; may lie outside.
    step : float
        px^2. Binning loses (2 pi n step / order)^2 / 12 of the information of the n-th harmonic of
        the ring profile, with `order` the step of r^2 from ring to ring.
    sectors : int
        Per turn; 1 for whole annuli.

    Raises
    ------
    InputError
        A step or number of sectors that is not above 0.
    """
    if not (math.isfinite(step) and step > 0):
        raise InputError(f"step: {step!r} px^2 is not allowed; expected above 0")
    if sectors < 1:
        raise InputError(f"sectors: {sectors!r} is not allowed; expected 1 or more")
    x, y = (values.flatten() for values in _positions(shape, centre, device))
    r2 = x**2 + y**2
    turn = (torch.atan2(y, x) / (2 * torch.pi) + 0.5) * sectors
    label = (r2 / step).long() * sectors + turn.long().clamp(max=sectors - 1)
    index, count = torch.unique(label, return_inverse=True, return_counts=True)[1:]

    def mean(values):
        total = torch.zeros(len(count), dtype=torch.float64, device=device)
        return total.index_add_(0, index, values) / count

    means = [mean(values) for values in (x, y, r2)]
    off = [values - middle[index] for values, middle in zip((x, y, r2), means, strict=True)]
    spread = torch.stack([torch.stack([mean(a * b) for a in off], -1) for b in off], -1)
    return Cells(index, count.double(), centre, *means, spread)


def annular_average(
    images: torch.Tensor, centre: tuple[float, float], step: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Mean r^2 (px^2), mean values and numbers of pixels of annuli of equal steps in r^2.

    Parameters
    ----------
    images : torch.Tensor, shape (..., height, width)
    centre, step
        As `annular_sectors`.
    """
    cells = annular_sectors(tuple(images.shape[-2:]), centre, step, 1, images.device)
    return cells.r2, cells.means(images), cells.count


def _positions(shape, centre, device):
    y, x = (
        torch.arange(size, dtype=torch.float64, device=device) - middle
        for size, middle in zip(shape, reversed(centre), strict=True)
    )
    return torch.broadcast_tensors(x[None, :], y[:, None])
