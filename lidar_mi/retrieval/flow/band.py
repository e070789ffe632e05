"""Quadratic forms of a plane flow's coefficients as band matrices, and their inverse.

The coefficients (component, knot along z, knot along y) couple only where the knots are at most
three apart. The matrix of a form is block banded, with one block for every knot along y.
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.flow.flow_spline import REACH, Mesh


def form(
    weight: torch.Tensor,
    mesh: Mesh,
    first: tuple[int, ...] = (0, 0),
    second: tuple[int, ...] = (0, 0),
    cells: slice | None = None,
) -> torch.Tensor:
    """Band (..., shift z, knot z, shift y, knot y) of sum(weight * D1 f * D2 f) over a mesh.

    weight has shape (..., *mesh.shape); D1 and D2 are derivatives of these orders in z and y.
    The sum may be limited to some cells along z; the band is then that of the knots of
    `Mesh.within`.
    """
    cells = cells or slice(0, mesh.axes[0].cells)
    along_z = mesh.products(0, first[0], second[0])
    along_y = mesh.products(1, first[1], second[1])[REACH:]
    rows = cells.stop - cells.start + REACH
    middle = weight.new_zeros(*weight.shape[:-2], len(along_z), rows, weight.shape[-1])
    for knots, nodes in mesh.groups(0, cells):
        part = along_z[:, knots, nodes]
        here = slice(knots.start - cells.start, knots.stop - cells.start)
        product = part.flatten(0, 1) @ weight[..., nodes, :]
        middle[..., here, :] += product.unflatten(-2, part.shape[:2])
    products = weight.new_zeros(*middle.shape[:-1], len(along_y), along_y.shape[1])
    for knots, nodes in mesh.groups(1):
        part = along_y[:, knots, nodes]
        product = middle[..., nodes] @ part.flatten(0, 1).T
        products[..., knots] += product.unflatten(-1, part.shape[:2])
    return products


def spread(band: torch.Tensor, mesh: Mesh, cells: slice | None = None) -> torch.Tensor:
    """Covariance (2, 2, *mesh.shape) of the components, as a factor gives it.

    Of a band of the knots of some cells along z (see `form`) at the nodes in these cells.
    """
    middle = along_z(band, mesh, 0, 0, cells)
    diagonal = along_y(middle[..., :1, :], mesh, 0, 0)
    ahead = along_y(middle[..., 1:, :], mesh, 0, 0, first_shift=1)
    # shifts back along y are those ahead with the components exchanged
    return diagonal + ahead + ahead.transpose(0, 1)


def along_z(
    band: torch.Tensor, mesh: Mesh, first: int, second: int, cells: slice | None = None
) -> torch.Tensor:
    """A covariance (..., shift z, knot z, shift y, knot y) at nodes z: (..., z, shift y, knot y).

    Of derivatives of these orders in z; of some cells along z as `form`.
    """
    cells = cells or slice(0, mesh.axes[0].cells)
    _, places = mesh.within(0, cells)
    products, sizes = mesh.products(0, first, second), band.shape[-2:]
    rows = band.new_empty(*band.shape[:-4], places.stop - places.start, *sizes)
    for knots, nodes in mesh.groups(0, cells):
        here = slice(knots.start - cells.start, knots.stop - cells.start)
        there = slice(nodes.start - places.start, nodes.stop - places.start)
        part = products[:, knots, nodes].flatten(0, 1).T
        of_group = part @ band[..., here, :, :].flatten(-4, -3).flatten(-2)
        rows[..., there, :, :] = of_group.unflatten(-1, sizes)
    return rows


def along_y(
    middle: torch.Tensor, mesh: Mesh, first: int, second: int, first_shift: int = 0
) -> torch.Tensor:
    """The sum over shifts along y, from this one on, of what `along_z` gives: (..., z, y)."""
    shifts = slice(REACH + first_shift, REACH + first_shift + middle.shape[-2])
    products = mesh.products(1, first, second)[shifts]
    columns = middle.new_empty(*middle.shape[:-2], products.shape[-1])
    for knots, nodes in mesh.groups(1):
        part = products[:, knots, nodes].flatten(0, 1)
        columns[..., nodes] = middle[..., knots].flatten(-2) @ part
    return columns


@dataclass(frozen=True)
class Band:
    """Quadratic forms of the coefficients (component, knot z, knot y) of a flow in a plane.

    A form is held as its band: (component, component, shift z, knot z, shift y, knot y),
    the coefficient at a knot against that at knot + shift, shifts from -3 to 3 in z and from 0 to
    3 in y. Couplings with knots beyond the first or last row do not count. There are ``rows`` and
    ``columns`` of knots along z and y.
    """

    rows: int
    columns: int

    def columns_of(self, form: torch.Tensor) -> torch.Tensor:
        """The blocks A[k + j, k] of forms (..., 2, 2, 7, Z, 4, Y): (knots y, ..., 4 n, n)."""
        knots, batch = self.rows, form.shape[:-6]
        # (knot y, ..., shift y, component, knot z there, component, knot z here)
        columns = form.new_zeros(self.columns, *batch, REACH + 1, 2, knots, 2, knots)
        # (knot y, ..., shift y, component there, component here, shift z, knot z)
        form = form.movedim(-1, 0).movedim(-1, -5).transpose(-4, -3)
        for shift in range(-REACH, REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            columns.diagonal(-shift, -3, -1).copy_(form[..., REACH + shift, rows])
        # (.., shift y, component there, knot z there, component here, knot z here)
        return columns.flatten(-2).flatten(-4, -2)

    def form_of(self, columns: torch.Tensor) -> torch.Tensor:
        """The transpose of `columns_of`: a form from its blocks."""
        knots, batch = self.rows, columns.shape[1:-2]
        columns = columns.unflatten(-1, (2, knots)).unflatten(-3, (REACH + 1, 2, knots))
        band = columns.new_zeros(*batch, 2, 2, 2 * REACH + 1, knots, REACH + 1, self.columns)
        for shift in range(-REACH, REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            # (knot y, ..., shift y, component there, component here, knot z)
            part = columns.diagonal(-shift, -3, -1).movedim(0, -1).movedim(-5, -2)
            for ahead in range(REACH + 1):
                here = part[..., ahead, : self.columns - ahead].transpose(-4, -3)
                band[..., REACH + shift, rows, ahead, : self.columns - ahead] = here
        return band

    def apply(self, band: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
        """The form's matrix times coefficients (..., 2, Z, Y)."""
        reach = REACH
        padded = pad(coefficients, (reach,) * 4)
        rows, columns = coefficients.shape[-2:]
        total = torch.zeros_like(padded)
        here = slice(reach, reach + rows), slice(reach, reach + columns)
        for i in range(2 * reach + 1):
            for j in range(reach + 1):
                there = slice(i, i + rows), slice(reach + j, reach + j + columns)
                part = band[:, :, i, :, j]
                total[..., *here] += (part * padded[..., None, :, *there]).sum(-3)
                if j:
                    total[..., *there] += (part * coefficients[..., None, :, :]).sum(-4)
        return total[..., *here]
