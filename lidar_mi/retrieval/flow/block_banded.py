"""Symmetric positive definite block banded matrices: their solution.

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
        """The solutions x of A x = right, both of shape (blocks, ..., n, number)."""
        blocks, n, number = len(right), *right.shape[-2:]
        rows = self.ratio.shape[-2]
        ratios = self.ratio.reshape(blocks, -1, rows, n)
        # blocks beyond the last one, which count nothing, spare the loop its exceptions
        some = torch.cat([right, right.new_zeros(rows // n, *right.shape[1:])])
        some = some.reshape(len(some), -1, n, number).transpose(0, 1).flatten(1, 2).contiguous()
        parts = [some[:, k * n : (k + 1) * n] for k in range(blocks)]
        beyond = [some[:, (k + 1) * n : (k + 1) * n + rows] for k in range(blocks)]
        for ratio, part, ahead in zip(ratios, parts, beyond, strict=True):
            ahead.baddbmm_(ratio, part, alpha=-1)
        root = self.root.reshape(blocks, -1, n, n)
        middle = some[:, : blocks * n].unflatten(1, (blocks, n)).transpose(0, 1)
        middle = root.mT @ (root @ middle)
        some[:, : blocks * n] = middle.transpose(0, 1).flatten(1, 2)
        some[:, blocks * n :] = 0.0
        for k in range(blocks - 1, -1, -1):
            parts[k].baddbmm_(ratios[k].mT, beyond[k], alpha=-1)
        solution = some[:, : blocks * n].unflatten(1, (blocks, n)).transpose(0, 1)
        return solution.reshape(right.shape)


def factor(columns: torch.Tensor) -> Factor:
    """Factor matrices with the blocks A[k + j, k], j = 0 to reach, (blocks, ..., (1 + reach) n, n).

    Blocks beyond the last one must be 0.

    Raises
    ------
    torch.linalg.LinAlgError
        A matrix is not positive definite.
    """
    shape, n = columns.shape[:-2], columns.shape[-1]
    reach = columns.shape[-2] // n - 1
    columns = columns.reshape(shape[0], -1, (1 + reach) * n, n)
    unit = torch.eye(n, dtype=columns.dtype, device=columns.device)
    unit = unit.expand(columns.shape[1], n, n)
    roots, ratios = torch.empty_like(columns[..., :n, :]), torch.empty_like(columns[..., n:, :])
    last: list[torch.Tensor] = []
    for k, column in enumerate(columns):
        left = column.clone() if last else column
        for j, below in enumerate(reversed(last)):
            one, other = below[:, j * n :], below[:, j * n : (j + 1) * n]
            left[:, : (reach - j) * n].baddbmm_(one, other.mT, alpha=-1)
        root = torch.linalg.cholesky(left[:, :n])
        # as accurate as substitution, which an inverse of the block itself would not be
        inverse = torch.linalg.solve_triangular(root, unit, upper=False)
        below = torch.bmm(left[:, n:], inverse.mT)
        torch.bmm(below, inverse, out=ratios[k])
        roots[k] = inverse
        last = [*last, below][-reach:]
    return Factor(roots.reshape(*shape, n, n), ratios.reshape(*shape, reach * n, n))
