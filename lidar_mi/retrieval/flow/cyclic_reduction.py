"""Factor of a quadratic form of a plane flow's coefficients by block cyclic reduction.

Every other block is eliminated at once, then every other one of those left, and so on (Buzbee,
Golub & Nielson 1970, SIAM J. Numer. Anal. 7, 627-656; Heller 1976, ibid. 13, 484-496). A form of n
blocks takes log2(n) rounds of a few batched operations instead of n one after the other, for some
four times as many multiplications: for a device of many units that is slow to be told what to do.
"""

from typing import NamedTuple

import torch
from torch.linalg import LinAlgError  # type: ignore[attr-defined]  # not in torch's own list
from torch.nn.functional import pad

from lidar_mi.retrieval.flow.band import Band
from lidar_mi.retrieval.flow.flow_spline import REACH


class Round(NamedTuple):
    """Blocks eliminated at once: A[o, o] = L L^T of each, coupled to one before and one behind.

    root (blocks, m, m): L, lower triangular.
    before, behind (blocks, m, m): L^-1 A[o, o - 1] and L^-1 A[o, o + 1]; 0 behind the last one.
    """

    root: torch.Tensor
    before: torch.Tensor
    behind: torch.Tensor


class CyclicFactor(NamedTuple):
    """Factor of one form, on the form's device.

    last (1, m, m): lower Cholesky factor of the block that is left.
    """

    rounds: list[Round]
    last: torch.Tensor
    band: Band

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, of right hand sides (..., 2, Z, Y), in their type."""
        band, shape = self.band, right.shape
        size, number = self.last.shape[-1], -(-band.columns // REACH)
        # (knot y, component and knot z, right hand side), a block for every three knots along y
        values = right.to(self.last).reshape(-1, 2 * band.rows, band.columns).permute(2, 1, 0)
        values = pad(values, (0, 0, 0, 0, 0, number * REACH - band.columns))
        values = values.reshape(number, size, -1)
        halves = []
        for root, before, behind in self.rounds:
            half = torch.linalg.solve_triangular(root, values[1::2], upper=False)
            values = _less(values[0::2], before.mT @ half, behind.mT @ half)
            halves.append(half)
        values = torch.cholesky_solve(values, self.last)
        for (root, before, behind), half in zip(
            reversed(self.rounds), reversed(halves), strict=True
        ):
            ahead = _of_behind(values, len(root))
            half = half - before @ values[: len(root)] - behind @ ahead
            block = torch.linalg.solve_triangular(root.mT, half, upper=True)
            values = _merged(values, block)
        solution = values.reshape(number * REACH, 2 * band.rows, -1)[: band.columns]
        return solution.permute(2, 1, 0).reshape(shape).to(right)

    def covariance(self) -> torch.Tensor:
        """The inverse within the band, as a form is held: (2, 2, 7, Z, 4, Y).

        Of an eliminated block it follows from that of the two that it was coupled to (Takahashi et
        al. 1973, Proc. 8th PICA Conf., 63-69).
        """
        diagonal = torch.cholesky_inverse(self.last)
        # [k + 1, k] of the blocks of a round, 0 behind the last one
        below = torch.zeros_like(diagonal)
        for root, before, behind in reversed(self.rounds):
            number = len(root)
            one, other = (
                torch.linalg.solve_triangular(root.mT, part, upper=True)
                for part in (before, behind)
            )
            ahead, between = _of_behind(diagonal, number), below[:number]
            with_before = -(one @ diagonal[:number] + other @ between)
            with_behind = -(one @ between.mT + other @ ahead)
            middle = torch.cholesky_inverse(root)
            middle = middle - with_before @ one.mT - with_behind @ other.mT
            # what is not symmetric by rounding would grow
            middle = (middle + middle.mT) / 2
            diagonal, below = (
                _merged(diagonal, middle),
                _merged(_of_before(with_before, len(diagonal)), with_behind.mT),
            )
        return self.band.form_of(_columns_of(diagonal, below, self.band))


def factored(forms: torch.Tensor) -> list[CyclicFactor]:
    """Factors of forms, bands (n, 2, 2, 7, Z, 4, Y), with one answer from the device.

    Raises
    ------
    torch.linalg.LinAlgError
        A form is not positive definite.
    """
    band = Band(forms.shape[-3], forms.shape[-1])
    # (block, form, m, m)
    diagonal, below = _blocks_of(band.columns_of(forms))
    rounds, failures = [], []

    def root_of(blocks: torch.Tensor) -> torch.Tensor:
        root, info = torch.linalg.cholesky_ex(blocks)
        failures.append(info)
        return root

    while len(diagonal) > 1:
        root = root_of(diagonal[1::2])
        number = len(root)
        before, behind = (
            torch.linalg.solve_triangular(root, part, upper=False)
            for part in (below[0::2][:number], below[1::2].mT)
        )
        rounds.append(Round(root, before, behind))
        between = -behind.mT @ before
        diagonal = _less(diagonal[0::2], before.mT @ before, behind.mT @ behind)
        below = torch.cat([between, torch.zeros_like(diagonal)])[: len(diagonal)]
    last = root_of(diagonal)
    if bool(torch.cat([info.flatten() for info in failures]).any()):
        raise LinAlgError("the quadratic form of a flow is not positive definite")
    return [
        CyclicFactor([Round(*(part[:, k] for part in one)) for one in rounds], last[:, k], band)
        for k in range(len(forms))
    ]


def _less(even: torch.Tensor, of_next: torch.Tensor, of_last: torch.Tensor) -> torch.Tensor:
    """The blocks left less what the one behind each and the one before it take of them."""
    left = even.clone()
    left[: len(of_next)] -= of_next
    left[1:] -= of_last[: len(even) - 1]
    return left


def _of_behind(even: torch.Tensor, number: int) -> torch.Tensor:
    """Of the blocks left, the one behind each of so many eliminated ones; 0 behind the last."""
    return torch.cat([even[1:], torch.zeros_like(even[:1])])[:number]


def _of_before(odd: torch.Tensor, number: int) -> torch.Tensor:
    """As many as blocks left, 0 where none was eliminated behind."""
    return torch.cat([odd, torch.zeros_like(odd[:1])])[:number]


def _merged(even: torch.Tensor, odd: torch.Tensor) -> torch.Tensor:
    """Blocks left and eliminated, in their order."""
    merged = even.new_empty(len(even) + len(odd), *even.shape[1:])
    merged[0::2], merged[1::2] = even, odd
    return merged


def _blocks_of(columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Diagonal blocks of three knots along y each (blocks, ..., m, m), and those below.

    columns (knots y, ..., 4 n, n): of `Band.columns_of`. Knots beyond the last one are 1.
    """
    n, knots, batch = columns.shape[-1], len(columns), columns.shape[1:-2]
    number = -(-knots // REACH)
    padded = columns.new_zeros(number * REACH, *columns.shape[1:])
    padded[:knots] = columns
    padded[knots:, ..., :n, :].diagonal(dim1=-2, dim2=-1).fill_(1.0)
    parts = padded.reshape(number, REACH, *batch, REACH + 1, n, n)
    diagonal, below = (columns.new_zeros(number, *batch, REACH, n, REACH, n) for _ in range(2))
    for j in range(REACH):
        for shift in range(REACH + 1):
            whole, i = divmod(j + shift, REACH)
            part = parts[:, j, ..., shift, :, :]
            (below if whole else diagonal)[..., i, :, j, :] = part
            if not whole and shift:
                diagonal[..., j, :, i, :] = part.mT
    m = REACH * n
    # nothing is behind the last one
    below[-1] = 0.0
    return diagonal.reshape(number, *batch, m, m), below.reshape(number, *batch, m, m)


def _columns_of(diagonal: torch.Tensor, below: torch.Tensor, band: Band) -> torch.Tensor:
    """The transpose of `_blocks_of`: (knots y, 4 n, n)."""
    n, number = 2 * band.rows, len(diagonal)
    diagonal, below = (part.reshape(number, REACH, n, REACH, n) for part in (diagonal, below))
    parts = diagonal.new_empty(number, REACH, REACH + 1, n, n)
    for j in range(REACH):
        for shift in range(REACH + 1):
            whole, i = divmod(j + shift, REACH)
            parts[:, j, shift] = (below if whole else diagonal)[:, i, :, j]
    return parts.reshape(number * REACH, (REACH + 1) * n, n)[: band.columns]
