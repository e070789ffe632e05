"""A flow as cubic B-splines in any number of dimensions: values anywhere, and their transpose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.images.windows import linear_weights, separable

REACH = 3
"""Knots further apart than this have no common support."""
# Cells along an axis that are multiplied at once: a spline is zero beyond four of them. Devices
# other than the processor take as long for a small product as for a larger one.
_CELLS, _CELLS_OF_DEVICE = 12, 64


@dataclass(frozen=True)
class Axis:
    """Cubic B-splines along one direction, from pixel 0 to size - 1.

    The spacing of the knots (px) is stretched so that knots are at both ends.
    """

    size: int
    spacing: float

    @property
    def cells(self) -> int:
        """Number of intervals between knots."""
        return max(1, math.floor((self.size - 1) / self.spacing))

    @property
    def knots(self) -> int:
        """Number of splines."""
        return self.cells + REACH

    def cell(self, place: torch.Tensor) -> torch.Tensor:
        """Number of the cell that each place (px) is in; the outermost ones hold what is beyond."""
        width = (self.size - 1) / self.cells
        return (place / width).floor().clamp(0, self.cells - 1).long()

    def basis(self, place: torch.Tensor, order: int = 0) -> torch.Tensor:
        """Matrix (place, knot) of derivatives of the splines, order 0 to 3, at places (px)."""
        width = (self.size - 1) / self.cells
        cell = self.cell(place)
        pieces = _pieces(place / width - cell, order) / width**order
        matrix = pieces.new_zeros(len(place), self.knots)
        columns = cell[:, None] + torch.arange(4, device=place.device)
        return matrix.scatter_(1, columns, pieces)


def _pieces(t: torch.Tensor, order: int) -> torch.Tensor:
    """The four cubic B-splines over a cell at the fraction t, or their derivatives; (..., 4)."""
    coefficients = (
        torch.tensor(
            [[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]],
            dtype=t.dtype,
            device=t.device,
        )
        / 6
    )
    for _ in range(order):
        coefficients = coefficients[:, 1:] * torch.arange(
            1, coefficients.shape[1], dtype=t.dtype, device=t.device
        )
    powers = torch.stack([t**k for k in range(coefficients.shape[1])], -1)
    return powers @ coefficients.T


class Mesh:
    """The splines along all axes at the nodes of a rectangular mesh.

    Axes are (z, y), or (x, z, y), with the places (px) of the nodes along each.
    """

    def __init__(self, axes: Sequence[Axis], places: Sequence[torch.Tensor]):
        self.axes, self.places = tuple(axes), tuple(places)
        self.shape = tuple(len(place) for place in places)
        self.dims = len(self.axes)
        self._bases: dict[tuple[int, int], torch.Tensor] = {}
        self._products: dict[tuple[int, int, int], torch.Tensor] = {}
        self._groups: dict[tuple[int, int, int], list[tuple[slice, slice]]] = {}
        self._nearest: list[torch.Tensor] = []

    def basis(self, axis: int, order: int = 0) -> torch.Tensor:
        """Matrix (place, knot) of a derivative of the splines along an axis."""
        if (axis, order) not in self._bases:
            self._bases[axis, order] = self.axes[axis].basis(self.places[axis], order)
        return self._bases[axis, order]

    def products(self, axis: int, first: int, second: int) -> torch.Tensor:
        """(shift, knot, place): the derivative `first` at a knot times `second` at knot + shift.

        Shifts from -3 to 3; zero where there is no such knot.
        """
        key = axis, first, second
        if key not in self._products:
            one, two = self.basis(axis, first).T, self.basis(axis, second).T
            padded = pad(two, (0, 0, REACH, REACH))
            self._products[key] = torch.stack(
                [one * padded[shift : shift + len(one)] for shift in range(2 * REACH + 1)]
            )
        return self._products[key]

    def within(self, axis: int, cells: slice) -> tuple[slice, slice]:
        """The knots whose splines reach into these cells, and the nodes in them, which ascend."""
        along = self.axes[axis]
        of_nodes = along.cell(self.places[axis])
        bounds = torch.tensor([cells.start, cells.stop]).to(of_nodes)
        start, stop = torch.searchsorted(of_nodes, bounds).tolist()
        return slice(cells.start, cells.stop + REACH), slice(start, stop)

    def groups(self, axis: int, cells: slice | None = None) -> list[tuple[slice, slice]]:
        """Knots and nodes of groups of cells, of all or of these; see `within`."""
        cells = cells or slice(0, self.axes[axis].cells)
        key = axis, cells.start, cells.stop
        if key not in self._groups:
            step = _CELLS if self.places[axis].device.type == "cpu" else _CELLS_OF_DEVICE
            self._groups[key] = [
                self.within(axis, slice(start, min(start + step, cells.stop)))
                for start in range(cells.start, cells.stop, step)
            ]
        return self._groups[key]

    def field(self, coefficients: torch.Tensor, order: Sequence[int] | None = None) -> torch.Tensor:
        """Derivatives of these orders, (..., *shape), from coefficients (..., knots)."""
        orders = order or (0,) * self.dims
        return separable(coefficients, [self.basis(axis, n) for axis, n in enumerate(orders)])

    def transposed(self, values: torch.Tensor, order: Sequence[int] | None = None) -> torch.Tensor:
        """The transpose of `field`: values (..., *shape) to coefficients (..., knots).

        The derivative of sum(values * field) by the coefficients.
        """
        orders = order or (0,) * self.dims
        return separable(values, [self.basis(axis, n).T for axis, n in enumerate(orders)])

    def slopes(self, coefficients: torch.Tensor) -> list[torch.Tensor]:
        """First derivatives along every axis."""
        orders = [tuple(int(a == axis) for a in range(self.dims)) for axis in range(self.dims)]
        return [self.field(coefficients, order) for order in orders]

    def fitted(self, flow: torch.Tensor) -> torch.Tensor:
        """Coefficients of the splines nearest to a flow (components, *shape)."""
        if not self._nearest:
            bases = [self.basis(axis) for axis in range(self.dims)]
            squares = [basis.T @ basis for basis in bases]
            for square in squares:
                square.diagonal().add_(1e-6)
            self._nearest = [
                torch.linalg.solve(square, basis.T)
                for square, basis in zip(squares, bases, strict=True)
            ]
        return separable(flow, self._nearest)


def halves(axes: Sequence[Axis], like: torch.Tensor) -> Mesh:
    """The mesh of the middles of all halves of the knots' cells."""
    places = []
    for axis in axes:
        number = torch.arange(2 * axis.cells, dtype=like.dtype, device=like.device)
        places.append((number + 0.5) * (axis.size - 1) / (2 * axis.cells))
    return Mesh(axes, places)


def interpolated(
    values: torch.Tensor, known: Sequence[torch.Tensor], places: Sequence[torch.Tensor]
) -> torch.Tensor:
    """Values (..., known places) at other places of a rectangular mesh, linearly between."""
    return separable(values, [linear_weights(k, p) for k, p in zip(known, places, strict=True)])
