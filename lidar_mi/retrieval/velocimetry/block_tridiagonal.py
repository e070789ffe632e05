"""Symmetric positive definite block tridiagonal matrices: solution, determinant, inverse."""

from typing import NamedTuple

import torch


class Factor(NamedTuple):
    """Cholesky factor of a block tridiagonal matrix.

    Attributes
    ----------
    diagonal : list of torch.Tensor, shape (n, n)
        Lower triangular.
    ratio : list of torch.Tensor, shape (n, n)
        A[k + 1, k] times the inverse of what elimination left of A[k, k].
    """

    diagonal: list[torch.Tensor]
    ratio: list[torch.Tensor]

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """The solution x of A x = right, both of shape (blocks, n, columns)."""
        middle = [right[0]]
        for ratio, part in zip(self.ratio, right[1:], strict=True):
            middle.append(part - ratio @ middle[-1])
        middle = [
            torch.cholesky_solve(part, root)
            for part, root in zip(middle, self.diagonal, strict=True)
        ]
        for k in range(len(self.ratio) - 1, -1, -1):
            middle[k] = middle[k] - self.ratio[k].T @ middle[k + 1]
        return torch.stack(middle)

    def inverse(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The blocks of A's inverse on the diagonal (blocks, n, n) and below (blocks - 1, n, n).

        By the recursion of Takahashi from the last block upwards: as much work as the factor.
        """
        diagonal = [torch.cholesky_inverse(self.diagonal[-1])]
        below = []
        for root, ratio in zip(reversed(self.diagonal[:-1]), reversed(self.ratio), strict=True):
            last = diagonal[-1]
            below.append(-last @ ratio)
            diagonal.append(torch.cholesky_inverse(root) - ratio.T @ below[-1])
        below = torch.stack(below[::-1]) if below else diagonal[0].new_empty(0, *diagonal[0].shape)
        return torch.stack(diagonal[::-1]), below


def factor(diagonal: torch.Tensor, below: torch.Tensor) -> Factor:
    """Factor the matrix with the blocks A[k, k] (blocks, n, n) and A[k + 1, k] (blocks - 1, n, n).

    Raises
    ------
    torch.linalg.LinAlgError
        The matrix is not positive definite.
    """
    roots, ratios = [torch.linalg.cholesky(diagonal[0])], []
    for here, side in zip(diagonal[1:], below, strict=True):
        half = torch.linalg.solve_triangular(roots[-1], side.T, upper=False)
        ratios.append(torch.linalg.solve_triangular(roots[-1].T, half, upper=True).T)
        roots.append(torch.linalg.cholesky(here - half.T @ half))
    return Factor(roots, ratios)
