"""Smooth variations over an image: polynomials r^n cos(m phi), r^n sin(m phi).

The radius is in half diagonals of the image, from its middle. They describe light that is not even
(its logarithm, so that it stays above 0) and a background that is not. The term r^2 of the light is
the `falloff` about the rings' centre, so it is not among the light's terms.
"""

from functools import lru_cache
from typing import TYPE_CHECKING

from lidar_mi.errors import InputError

if TYPE_CHECKING:
    import torch


MOST_DEGREE = 8


@lru_cache
def term_names(kind: str, degree: int) -> tuple[str, ...]:
    """Names of the terms of ``light`` or ``background`` up to a degree: kind_n_m, m < 0 the sine.

    Raises InputError: a degree that is not 0 to `MOST_DEGREE`.
    """
    if degree not in range(MOST_DEGREE + 1):
        raise InputError(f"{kind} degree: {degree!r} is not allowed; expected 0 to {MOST_DEGREE}")
    return tuple(
        f"{kind}_{n}_{m}" for n, m in _indices(degree) if kind != "light" or (n, m) != (2, 0)
    )


def term_values(names: tuple[str, ...], u: "torch.Tensor", v: "torch.Tensor") -> "torch.Tensor":
    """Values at places (u, v), half diagonals from the middle; shape (places, names)."""
    import torch

    indices = [tuple(map(int, name.split("_")[1:])) for name in names]
    # n - |m| is even: products of r e^(i phi) and r^2, no roots or powers of all pixels
    highest = max((n for n, _ in indices), default=0)
    waves, squares = [torch.complex(u, v)], [u**2 + v**2]
    for _ in range(1, highest):
        waves.append(waves[-1] * waves[0])
    for _ in range(1, highest // 2):
        squares.append(squares[-1] * squares[0])
    columns = []
    for n, m in indices:
        factors = []
        if m:
            factors.append(waves[abs(m) - 1].imag if m < 0 else waves[m - 1].real)
        if n > abs(m):
            factors.append(squares[(n - abs(m)) // 2 - 1])
        columns.append(factors[0] if len(factors) == 1 else factors[0] * factors[1])
    # every term's values lie side by side in memory
    return torch.stack(columns).T if columns else u.new_zeros((len(u), 0))


def _indices(degree: int) -> list[tuple[int, int]]:
    """n and m of all terms but the constant."""
    return [(n, m) for n in range(1, degree + 1) for m in range(n, -n - 1, -2)]
