"""Cholesky factor of one quadratic form of a plane flow's coefficients, by LAPACK, and its inverse.

With the coefficients in the order (knot along y, knot along z, component) a form (see `band.Band`)
is a band matrix. Its factor takes a third of the operations of that of blocks
(`block_banded.factor`), which serves many forms at once, and any device.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from lidar_mi.retrieval.flow.block_banded import Factor
from lidar_mi.retrieval.flow.flow_spline import REACH, Mesh


class BandCholesky(NamedTuple):
    """Lower Cholesky factor of a form, in the form's precision.

    Attributes
    ----------
    lower : ndarray, shape (1 + bandwidth, coefficients)
        Diagonals of the factor, as LAPACK's pbtrf stores them.
    rows, columns : int
        Knots along z and y.
    """

    lower: np.ndarray
    rows: int
    columns: int

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, from a right hand side (2, Z, Y) and in its type."""
        (solve,) = get_lapack_funcs(("pbtrs",), (self.lower,))
        values = right.detach().cpu().permute(2, 1, 0).reshape(-1, 1).numpy()
        found, _ = solve(self.lower, values.astype(self.lower.dtype), lower=True)
        return torch.as_tensor(found).reshape(self.columns, self.rows, 2).permute(2, 1, 0).to(right)

    def covariance(self) -> torch.Tensor:
        """The inverse within the band: (2, 2, 7, Z, 4, Y), shifts as in `band.Band`."""
        n, below = 2 * self.rows, len(self.lower) - 1
        # in memory an element of the matrix is followed by that below it, and that to its right
        # comes a column less one element later: block columns are views, here with their columns
        # as rows, where columns end in as many zeros as others may begin above their diagonal
        width, kind = below + 1 + n, torch.as_tensor(self.lower[:1, :1]).dtype
        padded = torch.zeros((self.columns + REACH + 1) * n, width, dtype=kind)
        padded[: self.lower.shape[1], : below + 1] = torch.as_tensor(self.lower.T)
        blocks = padded.as_strided((self.columns, n, (1 + REACH) * n), (n * width, width - 1, 1))
        own, others = blocks[..., :n], blocks[..., n:]
        (invert,) = get_lapack_funcs(("trtri",), (self.lower,))
        roots = np.stack([invert(block.T, lower=True)[0] for block in own.numpy()])
        root = torch.as_tensor(roots)
        ratio = root.mT @ others
        inverse = Factor(root, ratio.mT).inverse()
        there, _ = _places(self.rows, self.columns)
        found = torch.index_select(inverse.reshape(-1), 0, there.reshape(-1))
        return found.reshape(there.shape)


def packed(form: torch.Tensor) -> np.ndarray:
    """A form (2, 2, 7, Z, 4, Y) as LAPACK stores a band matrix: lower diagonals, in its precision.

    Of shape (1 + bandwidth, coefficients).
    """
    rows, columns = form.shape[3], form.shape[5]
    values = form.detach().cpu().numpy()
    _, (source, target) = _places(rows, columns)
    lower = np.zeros((2 * rows * columns, _bandwidth(rows) + 1), values.dtype)
    lower.reshape(-1)[target] = values.reshape(-1)[source]
    return lower.T


def cholesky(form: torch.Tensor) -> BandCholesky | None:
    """Factor of a form, a band of shape (2, 2, 7, Z, 4, Y); None if it is not positive definite."""
    lower = packed(form)
    (factor,) = get_lapack_funcs(("pbtrf",), (lower,))
    lower, info = factor(lower, lower=True, overwrite_ab=True)
    return None if info else BandCholesky(lower, form.shape[3], form.shape[5])


def solved_near(
    root: BandCholesky, form: torch.Tensor, right: torch.Tensor, left: float, most: int
) -> torch.Tensor | None:
    """Solution for a form near that of a factor, by conjugate gradients from that of the factor.

    Parameters
    ----------
    root : BandCholesky
        Of a similar form: the preconditioner.
    form : torch.Tensor
        A band (2, 2, 7, Z, 4, Y); products with it are in the factor's precision.
    right : torch.Tensor, shape (2, Z, Y)
    left : float
        Of the right hand side, how much the residual may be.
    most : int
        Products with the form; None if these leave more.
    """
    kind = root.lower.dtype
    lower = packed(form).astype(kind, copy=False)
    (product,) = get_blas_funcs(("sbmv",), (lower,))
    (solve,) = get_lapack_funcs(("pbtrs",), (lower,))
    residual = right.detach().cpu().permute(2, 1, 0).reshape(-1).numpy().astype(kind)
    enough = left * np.linalg.norm(residual)
    found, along, before = np.zeros_like(residual), None, 0.0
    for _ in range(most):
        nearer, _ = solve(root.lower, residual, lower=True)
        energy = float(residual @ nearer)
        along = nearer if along is None else nearer + energy / before * along
        pushed = product(len(lower) - 1, 1.0, lower, along, lower=True)
        part = energy / float(along @ pushed)
        found += part * along
        residual -= part * pushed
        before = energy
        if not np.linalg.norm(residual) > enough:
            shape = root.columns, root.rows, 2
            return torch.as_tensor(found).reshape(shape).permute(2, 1, 0).to(right)
    return None


def spread_half(band: torch.Tensor, mesh: Mesh) -> torch.Tensor:
    """Covariance (2, 2, *mesh.shape) of the components, from `BandCholesky.covariance`."""
    along_z = mesh.products(0, 0, 0).flatten(0, 1)
    along_y = mesh.products(1, 0, 0)[REACH:]
    middle = along_z.T @ band.flatten(2, 3).flatten(-2)
    own, others = (
        middle[..., : along_y.shape[1]] @ along_y[0],
        middle[..., along_y.shape[1] :] @ along_y[1:].flatten(0, 1),
    )
    # shifts back along y are those ahead with the components exchanged
    return own + others + others.transpose(0, 1)


def _bandwidth(rows: int) -> int:
    """Largest distance of two coupled coefficients."""
    return 2 * (REACH * rows + REACH) + 1


@lru_cache(maxsize=8)
def _places(rows: int, columns: int) -> tuple[torch.Tensor, tuple[np.ndarray, np.ndarray]]:
    """Where a form's entries are in the blocks of `covariance`, and source and target of a factor.

    Couplings with knots that do not exist have no target; in the blocks any entry stands for them.
    """
    sizes = 2, 2, 2 * REACH + 1, rows, REACH + 1, columns
    a, b, shift_z, z, shift_y, y = np.ogrid[tuple(slice(size) for size in sizes)]
    other = z + shift_z - REACH
    n, below = 2 * rows, _bandwidth(rows)
    in_block = 2 * (shift_y * rows + other.clip(0, rows - 1)) + b
    blocks = torch.as_tensor((y * (1 + REACH) * n + in_block) * n + 2 * z + a).int()
    below_diagonal = 2 * (shift_y * rows + shift_z - REACH) + b - a
    known = (other >= 0) & (other < rows) & (y + shift_y < columns) & (below_diagonal >= 0)
    known = np.broadcast_to(known, sizes)
    target = (2 * (y * rows + z) + a) * (below + 1) + below_diagonal
    return blocks, (np.flatnonzero(known), np.broadcast_to(target, sizes)[known])
