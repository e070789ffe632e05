"""Quadratic forms of a plane flow's coefficients as band matrices, and their inverse.

The coefficients (component, knot along z, knot along y) couple only where the knots are at most
three apart. With the knots along y in threes the matrix of a form is block tridiagonal.
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.velocimetry.block_tridiagonal import Factor, factor
from lidar_mi.retrieval.velocimetry.flow_spline import REACH, Axis, Mesh


@dataclass(frozen=True)
class Band:
    """Quadratic forms of the coefficients (component, knot z, knot y) of a flow in a plane.

    A form is held as its band: (component, component, shift z, knot z, shift y, knot y),
    the coefficient at a knot against that at knot + shift, shifts from -3 to 3 in z and from 0 to
    3 in y.
    """

    z: Axis
    y: Axis

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
        along_y = mesh.products(1, first[1], second[1])[REACH:]
        found = along_z.flatten(0, 1) @ weight @ along_y.flatten(0, 1).T
        return found.unflatten(-1, along_y.shape[:2]).unflatten(-3, along_z.shape[:2])

    def spread(
        self,
        band: torch.Tensor,
        mesh: Mesh,
        first: tuple[int, int] = (0, 0),
        second: tuple[int, int] = (0, 0),
    ) -> torch.Tensor:
        """Covariance (..., *mesh.shape) of two derivatives of components, from `covariance`."""
        along = [mesh.products(axis, first[axis], second[axis]).flatten(0, 1) for axis in (0, 1)]
        return along[0].T @ band.flatten(-4, -3).flatten(-2, -1) @ along[1]

    # --- the band as a block tridiagonal matrix: columns (knot y, component, knot z)

    @property
    def _blocks(self) -> int:
        return -(-self.y.knots // REACH)

    def factor(self, band: torch.Tensor) -> Factor:
        """Factor of the matrix of a quadratic form, band of shape (2, 2, 7, Z, 4, Y)."""
        knots, n = self.z.knots, 2 * self.z.knots
        band = pad(band, (0, self._blocks * REACH - self.y.knots)).unflatten(-1, (-1, REACH))
        # (block, y, component, z, y, component, z), what is below the diagonal alone
        shape = REACH, 2, knots, REACH, 2, knots
        diagonal = band.new_zeros(self._blocks, *shape)
        below = band.new_zeros(self._blocks - 1, *shape)
        for shift in range(-REACH, REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            # (block, y, shift y, z, component, component) to (.., component there, component here,
            # z)
            part = band[:, :, REACH + shift, rows].permute(4, 5, 3, 1, 0, 2)
            here, next_ = (blocks.diagonal(-shift, 3, 6) for blocks in (diagonal, below))
            for p in range(REACH):
                for q in range(REACH):
                    if q >= p:
                        here[:, q, :, p] = part[:, p, q - p]
                    if q <= p:
                        next_[:, q, :, p] = part[:-1, p, REACH + q - p]
        # knots that only fill up the last block
        filling = self._blocks * REACH - self.y.knots
        diagonal.reshape(self._blocks, REACH * n, -1)[-1].diagonal()[(REACH - filling) * n :] = 1
        side = REACH * n
        return factor(diagonal.reshape(-1, side, side), below.reshape(-1, side, side))

    def solve(self, root: Factor, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, from the right hand side (2, Z, Y)."""
        flat = right.permute(2, 0, 1).reshape(self.y.knots, -1)
        flat = pad(flat, (0, 0, 0, self._blocks * REACH - self.y.knots))
        found = root.solve(flat.reshape(self._blocks, -1, 1))
        return found.reshape(-1, 2, self.z.knots)[: self.y.knots].permute(1, 2, 0)

    def covariance(self, root: Factor) -> torch.Tensor:
        """The inverse within the band, all shifts: (2, 2, 7, Z, 7, Y)."""
        knots = self.z.knots
        diagonal, below = (
            blocks.reshape(-1, REACH, 2, knots, REACH, 2, knots) for blocks in root.inverse()
        )
        band = diagonal.new_zeros(2, 2, 2 * REACH + 1, knots, 2 * REACH + 1, self._blocks, REACH)
        for shift in range(-REACH, REACH + 1):
            rows = slice(max(0, -shift), knots - max(0, shift))
            # (component, component, z, shift y, block, y)
            part = band[:, :, REACH + shift, rows]
            # (y, y, component, component, z, block)
            here = diagonal.diagonal(shift, 3, 6).permute(1, 3, 2, 4, 5, 0)
            back = below.diagonal(shift, 3, 6).permute(1, 3, 2, 4, 5, 0)
            ahead = below.diagonal(-shift, 3, 6).permute(3, 1, 4, 2, 5, 0)
            for p in range(REACH):
                for q in range(REACH):
                    part[..., REACH + q - p, :, p] = here[p, q]
                    if q >= p:
                        # 3 (k + 1) + p against 3 k + q
                        part[..., q - p, 1:, p] = back[p, q]
                    if q <= p:
                        part[..., 2 * REACH + q - p, :-1, p] = ahead[p, q]
        band = band.flatten(-2)[..., : self.y.knots]
        return band

    def apply(self, band: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
        """The form's matrix times coefficients (2, Z, Y)."""
        reach = REACH
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
