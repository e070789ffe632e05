"""Symmetric positive definite block banded matrices: solution and inverse within the band.

A block is coupled to some before and as many behind it.
"""

from typing import NamedTuple

import torch


class Factor(NamedTuple):
    """Factor of one or more matrices A = (I + G) D (I + G)^T of blocks of size n, D diagonal.

    Attributes
    ----------
    root : torch.Tensor, shape (blocks, ..., n, n)
        The inverse of the Cholesky factor of each block of D.
    ratio : torch.Tensor, shape (blocks, ..., reach * n, n)
        The blocks of G below each diagonal one.
    """

    root: torch.Tensor
    ratio: torch.Tensor

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """The solution x of A x = right, both of shape (blocks, ..., n)."""
        blocks, n = len(right), right.shape[-1]
        rows = self.ratio.shape[-2]
        # blocks beyond the last one, which count nothing, spare the loop its exceptions
        some = torch.cat([right[..., None], right.new_zeros(rows // n, *right.shape[1:], 1)])
        some = some.movedim(0, -3).flatten(-3, -2).contiguous()
        for k, ratio in enumerate(self.ratio):
            start, stop = k * n, (k + 1) * n
            some[..., stop : stop + rows, :] -= ratio @ some[..., start:stop, :]
        middle = some[..., : blocks * n, :].unflatten(-2, (blocks, n)).movedim(-3, 0)
        middle = self.root.mT @ (self.root @ middle)
        some[..., : blocks * n, :] = middle.movedim(0, -3).flatten(-3, -2)
        some[..., blocks * n :, :] = 0.0
        for k in range(blocks - 1, -1, -1):
            start, stop = k * n, (k + 1) * n
            ahead = some[..., stop : stop + rows, :]
            some[..., start:stop, :] -= self.ratio[k].mT @ ahead
        return some[..., : blocks * n, 0].unflatten(-1, (blocks, n)).movedim(-2, 0)

    def inverse(self) -> torch.Tensor:
        """The inverse's blocks on and below the diagonal, (blocks, ..., (1 + reach) n, n).

        By the recursion of Takahashi from the last block upwards: as much work as the factor.
        """
        rows, n = self.ratio.shape[-2:]
        found = self.ratio.new_empty(*self.ratio.shape[:-2], n + rows, n)
        behind = found.new_zeros(*found.shape[1:-2], rows, rows)
        for k in range(len(found) - 1, -1, -1):
            root, ratio = self.root[k], self.ratio[k]
            below = behind @ ratio
            here = root.mT @ root + ratio.mT @ below
            found[k, ..., :n, :] = here = (here + here.mT) / 2
            found[k, ..., n:, :] = below.neg_()
            # shifted by one block, from the last to the first as memory is shared
            for j in range(rows // n - 1, 0, -1):
                behind[..., j * n : (j + 1) * n, n:] = behind[..., (j - 1) * n : j * n, :-n]
            behind[..., n:, :n] = below[..., :-n, :]
            behind[..., :n, n:] = below[..., :-n, :].mT
            behind[..., :n, :n] = here
        return found


def factor(columns: torch.Tensor) -> Factor:
    """Factor matrices with the blocks A[k + j, k], j = 0 to reach.

    Parameters
    ----------
    columns : torch.Tensor, shape (blocks, ..., (1 + reach) n, n)
        Blocks beyond the last one must be 0.

    Raises
    ------
    torch.linalg.LinAlgError
        A matrix is not positive definite.
    """
    n = columns.shape[-1]
    reach = columns.shape[-2] // n - 1
    unit = torch.eye(n, dtype=columns.dtype, device=columns.device)
    unit = unit.expand(*columns.shape[1:-2], n, n)
    roots, ratios = torch.empty_like(columns[..., :n, :]), torch.empty_like(columns[..., n:, :])
    last: list[torch.Tensor] = []
    for k, column in enumerate(columns):
        left = column.clone() if last else column
        for j, below in enumerate(reversed(last)):
            part = left[..., : (reach - j) * n, :]
            part -= below[..., j * n :, :] @ below[..., j * n : (j + 1) * n, :].mT
        root = torch.linalg.cholesky(left[..., :n, :])
        # as accurate as substitution, which an inverse of the block itself would not be
        inverse = torch.linalg.solve_triangular(root, unit, upper=False)
        below = left[..., n:, :] @ inverse.mT
        torch.matmul(below, inverse, out=ratios[k])
        roots[k] = inverse
        last = [*last, below][-reach:]
    return Factor(roots, ratios)
