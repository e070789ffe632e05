"""Cholesky factor of one quadratic form of a plane flow's coefficients, by LAPACK, and its inverse.

With the coefficients in the order (knot along y, knot along z, component) a form (see `band.Band`)
is a band matrix. Other devices have `cyclic_reduction`.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from torch.linalg import LinAlgError  # type: ignore[attr-defined]  # not in torch's own list

from lidar_mi.retrieval.flow.flow_spline import REACH
from lidar_mi.retrieval.threads import mapped


@dataclass(frozen=True, eq=False)
class BandCholesky:
    """Lower Cholesky factor of a form, in the form's precision.

    lower (1 + bandwidth, coefficients): diagonals of the factor, as LAPACK's pbtrf stores them.
    rows, columns: knots along z and y.
    """

    lower: np.ndarray
    rows: int
    columns: int

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, of right hand sides (..., 2, Z, Y), in their type."""
        ordered = right.detach().cpu().transpose(-1, -3)
        values = ordered.reshape(-1, self.lower.shape[1]).numpy().astype(self.lower.dtype)
        if len(values) > 1:
            # LAPACK takes one right hand side after the other
            solution = self._solved(np.ascontiguousarray(values.T)).T
        else:
            (solve,) = get_lapack_funcs(("pbtrs",), (self.lower,))
            solution, _ = solve(self.lower, values.T, lower=True)
        return torch.as_tensor(solution).reshape(ordered.shape).transpose(-1, -3).to(right)

    @cached_property
    def single(self) -> "BandCholesky":
        """The same in single precision."""
        return BandCholesky(self.lower.astype(np.float32), self.rows, self.columns)

    def covariance(self) -> torch.Tensor:
        """The inverse within the band, as a form is held: (2, 2, 7, Z, 4, Y)."""
        there, _ = _places(self.rows, self.columns)
        inverse = torch.as_tensor(self._inverse())
        covariance = torch.index_select(inverse.reshape(-1), 0, there.reshape(-1))
        return covariance.reshape(there.shape)

    @cached_property
    def _blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """A = (I + G) D (I + G)^T by blocks of size n, one for every knot along y.

        The inverse of the Cholesky factor of each block of D, (blocks, n, n), and the transposed
        blocks of G below each diagonal one, (blocks, n, 3 n).
        """
        n, below = 2 * self.rows, len(self.lower) - 1
        # in memory an element of the matrix is followed by that below it, and that to its right
        # comes a column less one element later: block columns are views, here with their columns
        # as rows, where columns end in as many zeros as others may begin above their diagonal
        width, kind = below + 1 + n, self.lower.dtype
        padded = np.zeros(((self.columns + REACH + 1) * n, width), kind)
        padded[: self.lower.shape[1], : below + 1] = self.lower.T
        steps = [kind.itemsize * step for step in (n * width, width - 1, 1)]
        blocks = as_strided(padded, (self.columns, n, (1 + REACH) * n), steps)
        (invert,) = get_lapack_funcs(("trtri",), (self.lower,))
        roots = np.empty((self.columns, n, n), kind)
        ratios = np.empty((self.columns, n, REACH * n), kind)
        for block, root, ratio in zip(blocks, roots, ratios, strict=True):
            root[:] = invert(block[:, :n].T, lower=True)[0]
            np.dot(root.T, block[:, n:], out=ratio)
        return roots, ratios

    def _solved(self, right: np.ndarray) -> np.ndarray:
        """The solutions of right hand sides (coefficients, number)."""
        roots, ratios = self._blocks
        n = roots.shape[-1]
        # blocks beyond the last one, which count nothing, spare the loops their exceptions
        solution = np.concatenate([right, np.zeros((REACH * n, right.shape[1]), right.dtype)])
        parts = [solution[k * n : (k + 1) * n] for k in range(self.columns)]
        ahead = [solution[(k + 1) * n : (k + 1 + REACH) * n] for k in range(self.columns)]
        for ratio, part, others in zip(ratios, parts, ahead, strict=True):
            others -= ratio.T @ part
        solution[len(right) :] = 0.0
        for k in range(self.columns - 1, -1, -1):
            parts[k][:] = roots[k].T @ (roots[k] @ parts[k]) - ratios[k] @ ahead[k]
        return solution[: len(right)]

    def _inverse(self) -> np.ndarray:
        """The inverse's blocks on and below the diagonal, (blocks, n, 4 n), transposed.

        From the last block upwards (Takahashi et al. 1973, Proc. 8th PICA Conf., 63-69). The
        inverse of the blocks behind is held in a ring: each takes the place of the one that is no
        longer needed.
        """
        roots, ratios = self._blocks
        n = roots.shape[-1]
        columns = np.empty((self.columns, n, (1 + REACH) * n), roots.dtype)
        around = np.zeros((REACH * n, REACH * n), roots.dtype)
        for k in range(self.columns - 1, -1, -1):
            turned = (k + 1) % REACH * n
            ratio = _turned(ratios[k], turned)
            below = ratio @ around
            here = roots[k].T @ roots[k] + below @ ratio.T
            # what is not symmetric by rounding would grow
            here = (here + here.T) / 2
            block = slice(k % REACH * n, (k % REACH + 1) * n)
            np.negative(below, out=below)
            around[block], around[:, block] = below, below.T
            around[block, block] = here
            columns[k, :, :n], columns[k, :, n:] = here, _turned(below, REACH * n - turned)
        return columns


def _turned(row: np.ndarray, by: int) -> np.ndarray:
    """Columns moved to the right, the last ones to the front."""
    return np.concatenate([row[:, -by:], row[:, :-by]], 1) if by % row.shape[1] else row


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


def factored(forms: torch.Tensor) -> list[BandCholesky]:
    """Factors of forms, bands (n, 2, 2, 7, Z, 4, Y), in double precision.

    Raises
    ------
    torch.linalg.LinAlgError
        A form is not positive definite.
    """
    roots = [root for root in mapped(cholesky, forms.double()) if root]
    if len(roots) < len(forms):
        raise LinAlgError("the quadratic form of a flow is not positive definite")
    return roots


def solved_near(
    root: BandCholesky, form: torch.Tensor, right: torch.Tensor, left: float, most: int
) -> torch.Tensor | None:
    """Solution for a form near that of a factor, by conjugate gradients from that of the factor.

    root: of a similar form: the preconditioner.
    form: a band (2, 2, 7, Z, 4, Y); products with it are in the factor's precision.
    right (2, Z, Y)
    left: of the right hand side, how much the residual may be.
    most: products with the form; None if these leave more.
    """
    kind = root.lower.dtype
    lower = packed(form).astype(kind, copy=False)
    (product,) = get_blas_funcs(("sbmv",), (lower,))
    (solve,) = get_lapack_funcs(("pbtrs",), (lower,))
    residual = right.detach().cpu().permute(2, 1, 0).reshape(-1).numpy().astype(kind)
    enough = left * np.linalg.norm(residual)
    solution, along, before = np.zeros_like(residual), None, 0.0
    for _ in range(most):
        nearer, _ = solve(root.lower, residual, lower=True)
        energy = float(residual @ nearer)
        along = nearer if along is None else nearer + energy / before * along
        pushed = product(len(lower) - 1, 1.0, lower, along, lower=True)
        part = energy / float(along @ pushed)
        solution += part * along
        residual -= part * pushed
        before = energy
        if not np.linalg.norm(residual) > enough:
            shape = root.columns, root.rows, 2
            return torch.as_tensor(solution).reshape(shape).permute(2, 1, 0).to(right)
    return None


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
    blocks = torch.as_tensor((y * n + 2 * z + a) * (1 + REACH) * n + in_block).int()
    below_diagonal = 2 * (shift_y * rows + shift_z - REACH) + b - a
    known = (other >= 0) & (other < rows) & (y + shift_y < columns) & (below_diagonal >= 0)
    known = np.broadcast_to(known, sizes)
    target = (2 * (y * rows + z) + a) * (below + 1) + below_diagonal
    return blocks, (np.flatnonzero(known), np.broadcast_to(target, sizes)[known])
