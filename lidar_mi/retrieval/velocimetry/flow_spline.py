"""A flow as cubic B-splines: values anywhere, quadratic forms in its coefficients, their inverse.

The coefficients (component, knot along z, knot along y) couple only where the knots are at most
three apart. With the knots along y in threes the matrix of a quadratic form is block tridiagonal.
"""

import math
from dataclasses import dataclass

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.velocimetry.block_tridiagonal import Factor, factor

_REACH = 3


@dataclass(frozen=True)
class Axis:
    """Cubic B-splines along one direction, from pixel 0 to size - 1.

    Attributes
    ----------
    size : int
        Pixels.
    spacing : float
        Between knots, px; stretched so that knots are at both ends.
    """

    size: int
    spacing: float

    @property
    def cells(self) -> int:
        return max(1, math.floor((self.size - 1) / self.spacing))

    @property
    def knots(self) -> int:
        return self.cells + _REACH

    def basis(self, place: torch.Tensor, order: int = 0) -> torch.Tensor:
        """Matrix (place, knot) of the splines' derivatives of this order, 0 to 3, at places (px)."""
        width = (self.size - 1) / self.cells
        scaled = place / width
        cell = scaled.floor().clamp(0, self.cells - 1)
        pieces = _pieces(scaled - cell, order) / width**order
        matrix = pieces.new_zeros(len(place), self.knots)
        columns = cell.long()[:, None] + torch.arange(4, device=place.device)
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
    """The splines of both directions, and their products, at the nodes of a rectangular mesh.

    Parameters
    ----------
    axes : (Axis, Axis)
        z, y.
    places : (torch.Tensor, torch.Tensor)
        Rows and columns, px.
    """

    def __init__(self, axes: tuple[Axis, Axis], places: tuple[torch.Tensor, torch.Tensor]):
        self.axes, self.places = axes, places
        self.shape = tuple(len(place) for place in places)
        self._bases = {}
        self._products = {}

    def basis(self, axis: int, order: int = 0) -> torch.Tensor:
        """(place, knot)"""
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
            padded = pad(two, (0, 0, _REACH, _REACH))
            self._products[key] = torch.stack(
                [one * padded[shift : shift + len(one)] for shift in range(2 * _REACH + 1)]
            )
        return self._products[key]


@dataclass(frozen=True)
class FlowSpline:
    """A flow of two components, z and y, over the pixels of an image.

    A quadratic form is held as its band: (component, component, shift z, knot z, shift y, knot y),
    the coefficient at a knot against that at knot + shift, shifts from -3 to 3 in z and from 0 to
    3 in y.
    """

    z: Axis
    y: Axis

    @property
    def shape(self) -> tuple[int, int, int]:
        return 2, self.z.knots, self.y.knots

    def mesh(self, z: torch.Tensor, y: torch.Tensor) -> Mesh:
        return Mesh((self.z, self.y), (z, y))

    def field(
        self, coefficients: torch.Tensor, mesh: Mesh, order: tuple[int, int] = (0, 0)
    ) -> torch.Tensor:
        """Derivative of these orders (z, y) of every component, (2, *mesh.shape)."""
        return mesh.basis(0, order[0]) @ coefficients @ mesh.basis(1, order[1]).T

    def pulled(self, slope: torch.Tensor, mesh: Mesh) -> torch.Tensor:
        """The coefficients' derivative (2, knots) of sum(slope * field) over the mesh."""
        return mesh.basis(0).T @ slope @ mesh.basis(1)

    def form(
        self,
        weight: torch.Tensor,
        mesh: Mesh,
        first: tuple[int, int] = (0, 0),
        second: tuple[int, int] = (0, 0),
    ) -> torch.Tensor:
        """Band (..., shift z, knot z, shift y, knot y) of sum(weight * D1 f * D2 f) over the mesh.

        weight has shape (..., *mesh.shape); D1 and D2 are derivatives of these orders in z and y.
        """
        along_z = mesh.products(0, first[0], second[0])
        along_y = mesh.products(1, first[1], second[1])[_REACH:]
        found = along_z.flatten(0, 1) @ weight @ along_y.flatten(0, 1).T
        return found.unflatten(-1, along_y.shape[:2]).unflatten(-3, along_z.shape[:2])

    def spread(
        self,
        band: torch.Tensor,
        mesh: Mesh,
        first: tuple[int, int] = (0, 0),
        second: tuple[int, int] = (0, 0),
    ) -> torch.Tensor:
        """Covariance (..., *mesh.shape) of two derivatives of components, from `covariance`'s band."""
        along = [mesh.products(axis, first[axis], second[axis]).flatten(0, 1) for axis in (0, 1)]
        return along[0].T @ band.flatten(-4, -3).flatten(-2, -1) @ along[1]

    # --- the band as a block tridiagonal matrix: columns (knot y, component, knot z)

    @property
    def _blocks(self) -> int:
        return -(-self.y.knots // _REACH)

    def factor(self, band: torch.Tensor) -> Factor:
        """Factor of the matrix of a quadratic form, band of shape (2, 2, 7, Z, 4, Y)."""
        knots, n = self.z.knots, 2 * self.z.knots
        band = pad(band, (0, self._blocks * _REACH - self.y.knots)).unflatten(-1, (-1, _REACH))
        # (block, y, component, z, y, component, z), what is below the diagonal alone
        shape = _REACH, 2, knots, _REACH, 2, knots
        diagonal = band.new_zeros(self._blocks, *shape)
        below = band.new_zeros(self._blocks - 1, *shape)
        for shift in range(-_REACH, _REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            # (block, y, shift y, z, component, component) to (.., component there, component here, z)
            part = band[:, :, _REACH + shift, rows].permute(4, 5, 3, 1, 0, 2)
            here, next_ = (blocks.diagonal(-shift, 3, 6) for blocks in (diagonal, below))
            for p in range(_REACH):
                for q in range(_REACH):
                    if q >= p:
                        here[:, q, :, p] = part[:, p, q - p]
                    if q <= p:
                        next_[:, q, :, p] = part[:-1, p, _REACH + q - p]
        # knots that only fill up the last block
        filling = self._blocks * _REACH - self.y.knots
        diagonal.reshape(self._blocks, _REACH * n, -1)[-1].diagonal()[(_REACH - filling) * n :] = 1
        side = _REACH * n
        return factor(diagonal.reshape(-1, side, side), below.reshape(-1, side, side))

    def solve(self, root: Factor, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, from the right hand side (2, Z, Y)."""
        flat = right.permute(2, 0, 1).reshape(self.y.knots, -1)
        flat = pad(flat, (0, 0, 0, self._blocks * _REACH - self.y.knots))
        found = root.solve(flat.reshape(self._blocks, -1, 1))
        return found.reshape(-1, 2, self.z.knots)[: self.y.knots].permute(1, 2, 0)

    def covariance(self, root: Factor) -> torch.Tensor:
        """The inverse within the band, all shifts: (2, 2, 7, Z, 7, Y)."""
        knots = self.z.knots
        diagonal, below = (
            blocks.reshape(-1, _REACH, 2, knots, _REACH, 2, knots) for blocks in root.inverse()
        )
        band = diagonal.new_zeros(2, 2, 2 * _REACH + 1, knots, 2 * _REACH + 1, self._blocks, _REACH)
        for shift in range(-_REACH, _REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            # (component, component, z, shift y, block, y)
            part = band[:, :, _REACH + shift, rows]
            # (y, y, component, component, z, block)
            here = diagonal.diagonal(shift, 3, 6).permute(1, 3, 2, 4, 5, 0)
            back = below.diagonal(shift, 3, 6).permute(1, 3, 2, 4, 5, 0)
            ahead = below.diagonal(-shift, 3, 6).permute(3, 1, 4, 2, 5, 0)
            for p in range(_REACH):
                for q in range(_REACH):
                    part[..., _REACH + q - p, :, p] = here[p, q]
                    if q >= p:
                        # 3 (k + 1) + p against 3 k + q
                        part[..., q - p, 1:, p] = back[p, q]
                    if q <= p:
                        part[..., 2 * _REACH + q - p, :-1, p] = ahead[p, q]
        band = band.flatten(-2)[..., : self.y.knots]
        return band

    def apply(self, band: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
        """The form's matrix times coefficients (2, Z, Y)."""
        reach = _REACH
        padded = pad(coefficients, (reach,) * 4)
        _, rows, columns = coefficients.shape
        total = torch.zeros_like(padded)
        here = slice(reach, reach + rows), slice(reach, reach + columns)
        for i in range(2 * reach + 1):
            for j in range(reach + 1):
                there = slice(i, i + rows), slice(reach + j, reach + j + columns)
                part = band[:, :, i, :, j]
                total[:, *here] += (part * padded[None, :, *there]).sum(1)
                if j:
                    total[:, *there] += (part * coefficients[:, None]).sum(0)
        return total[:, *here]
