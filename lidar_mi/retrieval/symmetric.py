"""Eigenvalues of many small symmetric matrices, on any device."""

import torch

MOST = 1 << 15
"""Matrices of a call: the solver of CUDA refuses more than 65 535."""


def eigenvalues(
    a: torch.Tensor, b: torch.Tensor, d: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The smaller and the larger eigenvalue of the matrices [[a, b], [b, d]], by element.

    In closed form, (a + d) / 2 -+ ((a - d)^2 / 4 + b^2)^(1/2), exact to rounding of the largest
    element.
    """
    middle, radius = a / 2 + d / 2, torch.hypot(a / 2 - d / 2, b)
    return middle - radius, middle + radius


def largest_eigenvalue(matrices: torch.Tensor) -> torch.Tensor:
    """The largest eigenvalue (...) of finite symmetric matrices (..., n, n).

    Of 2 x 2 in closed form, see `eigenvalues`; of others by `torch.linalg.eigvalsh`, some at a
    time.
    """
    if matrices.shape[-1] == 2:
        return eigenvalues(matrices[..., 0, 0], matrices[..., 1, 0], matrices[..., 1, 1])[1]
    flat = matrices.flatten(0, -3) if matrices.ndim > 2 else matrices[None]
    largest = torch.cat([torch.linalg.eigvalsh(part)[:, -1] for part in flat.split(MOST)])
    return largest.reshape(matrices.shape[:-2])
