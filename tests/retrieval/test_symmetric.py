"""Eigenvalues of small matrices. Unit tier.

Detects a closed form that loses digits where both eigenvalues are alike, far apart or very large or
small, and a batch that a solver refuses.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval import symmetric
from lidar_mi.retrieval.symmetric import eigenvalues, largest_eigenvalue

EPS = 2.0**-52


def matrices(count, n, seed):
    """Symmetric ones of all scales, among them degenerate, singular, diagonal and graded ones."""
    rng = np.random.default_rng(seed)
    found = rng.standard_normal((count, n, n)) * 10.0 ** rng.uniform(-140, 140, (count, 1, 1))
    graded = 10.0 ** rng.uniform(-12, 0, (count // 4, n))
    found[: count // 4] *= graded[:, :, None] * graded[:, None]
    found = found + found.swapaxes(1, 2)
    found[-8:] = np.eye(n) * 10.0 ** np.linspace(-200, 200, 8)[:, None, None]
    found[-16:-8] = found[-16:-8, :1, 0][..., None]  # of rank one
    found[-17] = 0
    return torch.from_numpy(found)


@pytest.mark.parametrize("n", [2, 3])
def test_as_the_solver_of_lapack(n):
    """To twice the unit round-off of the largest element, 4.4e-16; LAPACK has a part of it."""
    given = matrices(20_000, n, 1)
    expected = torch.linalg.eigvalsh(given)[:, -1]
    size = given.abs().amax((1, 2))
    off = (largest_eigenvalue(given) - expected).abs()
    assert (off <= 4 * EPS * size).all() and off.median() <= EPS * size.median()
    assert largest_eigenvalue(given[0]).shape == ()
    assert largest_eigenvalue(given.reshape(100, 200, n, n)).shape == (100, 200)


def test_against_exact_numbers():
    """Of covariances of two directions: [[s, c], [c, s]] has s + |c|; to the last bit but one."""
    for s, c in ((1.0, 1e-300), (3.0, -2.0), (1e-160, 1e-160), (2.0**500, 2.0**499), (0.1, 0.3)):
        given = torch.tensor([[s, c], [c, s]], dtype=torch.float64)
        assert float(largest_eigenvalue(given)) == pytest.approx(s + abs(c), rel=2 * EPS, abs=0)
    # (a + d) / 2 + |(a - d) / 2| is a to rounding
    wide = torch.tensor([[1e10, 0.0], [0.0, 1e-10]], dtype=torch.float64)
    assert float(largest_eigenvalue(wide)) == 1e10


def test_solvers_get_no_more_than_they_take(monkeypatch):
    """CUDA's refuses 65 536 matrices and more."""
    solve, sizes = torch.linalg.eigvalsh, []

    def limited(given):
        sizes.append(len(given))
        if len(given) > 65_535:
            raise RuntimeError("CUSOLVER_STATUS_INVALID_VALUE")
        return solve(given)

    monkeypatch.setattr(symmetric.torch.linalg, "eigvalsh", limited)
    given = matrices(70_000, 3, 2)
    assert torch.equal(largest_eigenvalue(given), solve(given)[:, -1])
    assert sum(sizes) == 70_000 and len(sizes) > 1
    assert torch.equal(
        largest_eigenvalue(given[:, :2, :2])[:5], largest_eigenvalue(given[:5, :2, :2])
    )
    assert sum(sizes) == 70_000


def test_both_of_two_by_two_are_those_of_lapack():
    given = matrices(20_000, 2, 3)
    expected = torch.linalg.eigvalsh(given)
    found = torch.stack(eigenvalues(given[:, 0, 0], given[:, 1, 0], given[:, 1, 1]), 1)
    assert ((found - expected).abs() <= 4 * EPS * given.abs().amax((1, 2))[:, None]).all()
