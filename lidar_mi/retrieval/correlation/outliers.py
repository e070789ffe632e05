"""Normalised median test: outliers among their neighbours, and their replacement."""

import math
from itertools import product

import torch
from torch.nn.functional import pad

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images import windows as geometry

MEDIAN_THRESHOLD = 2.0
"""Of the normalised residual (Westerweel & Scarano 2005)."""
MEDIAN_EPSILON = 0.1
"""Expected noise of a displacement, px (Westerweel & Scarano 2005)."""


def median_outliers(
    d: torch.Tensor,
    size: int = 3,
    spacing: int = 1,
    threshold: float = MEDIAN_THRESHOLD,
    epsilon: float = MEDIAN_EPSILON,
    continued: bool = False,
) -> torch.Tensor:
    """Normalised median test of Westerweel & Scarano (2005, Exp. Fluids 39, 1096-1100).

    A vector's difference to the median of its neighbours, over the median of the neighbours' own
    differences plus `epsilon`; all components together must not exceed `threshold`.

    d (components, ...): displacements in pixels; NaN where there is none.
    size: neighbourhood of `size` vectors along each axis, 3 or 5.
    spacing: vectors from one neighbour to the next. Vectors whose windows nearly coincide have
        common errors, which the test does not detect: it expects windows to overlap by half or
        less.
    threshold: 2 in the paper.
    epsilon: expected noise of a displacement, px.
    continued: beyond the rim the field is continued by point reflection. Else only the neighbours
        inside are used; most of them lie on one side, which rejects the rim in a shear of more than
        0.2 px per neighbour.

    Raises InputError: size not 3 or 5; spacing below 1; threshold or epsilon not positive.

    Returns
    -------
    torch.Tensor of bool
        False also where the vector or all but two of its neighbours are missing.
    """
    if size not in (3, 5):
        raise InputError(f"median_size: {size!r} is not 3 or 5")
    if spacing < 1:
        raise InputError(f"spacing: {spacing!r} is not an integer >= 1")
    for name, value in (("median_threshold", threshold), ("median_epsilon", epsilon)):
        if not value > 0:
            raise InputError(f"{name}: {value!r} is not > 0")
    dims = d.ndim - 1
    rim = size // 2 * spacing
    padded = _continued(d, rim) if continued else pad(d, (rim,) * 2 * dims, value=torch.nan)
    rows = max(1, geometry.tile_bytes() // (8 * 5 * size**dims * math.prod(d.shape[2:])))
    bands = []
    for top in range(0, d.shape[1], rows):
        residuals = [
            _normalised_residual(
                part[top : top + rows],
                _neighbours(wider[top : top + rows + 2 * rim], rim, spacing),
                epsilon,
            )
            for part, wider in zip(d, padded, strict=True)
        ]
        bands.append(torch.stack(residuals).norm(dim=0) > threshold)
    return torch.cat(bands)


def validated(
    d: torch.Tensor,
    spacing: int,
    threshold: float = MEDIAN_THRESHOLD,
    epsilon: float = MEDIAN_EPSILON,
    continued: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacements (components, ...) with outliers and gaps filled from their neighbours.

    Outliers are those of the normalised median test. Gaps take the median of their neighbours,
    from the rim of a gap inwards; without any vector at all the displacement is zero. Returns
    them and where they were replaced.
    """
    wrong = d.isnan().any(0) | median_outliers(d, 3, spacing, threshold, epsilon, continued)
    d = torch.where(wrong, torch.nan, d)
    while bool((gap := d[0].isnan()).any()) and not bool(gap.all()):
        nothing = pad(d, (1,) * 2 * (d.ndim - 1), value=torch.nan)
        padded = _continued(d, 1) if continued else nothing
        d = torch.where(gap, torch.stack([_median(_neighbours(p, 1, 1)) for p in padded]), d)
    return d.nan_to_num(0.0), wrong


def _continued(d: torch.Tensor, rim: int) -> torch.Tensor:
    """A field with a margin beyond every face, by point reflection at the outermost vectors."""
    for axis in range(1, d.ndim):
        n = d.shape[axis]
        place = torch.arange(-rim, n + rim, device=d.device)
        edge = place.clamp(0, n - 1)
        inner = 2 * edge - place
        known = ((inner >= 0) & (inner < n)).reshape(-1, *[1] * (d.ndim - 1 - axis))
        inner = d.index_select(axis, inner.clamp(0, n - 1))
        d = torch.where(known, 2 * d.index_select(axis, edge) - inner, torch.nan)
    return d


def _normalised_residual(
    values: torch.Tensor, around: torch.Tensor, epsilon: float
) -> torch.Tensor:
    """|u - median| / (median of |neighbour - median| + epsilon); 0 with two neighbours or less."""
    middle = _median(around)
    spread = _median((around - middle).abs())
    enough = (~torch.isnan(around)).sum(0) > 2
    return torch.where(enough, (values - middle).abs() / (spread + epsilon), 0.0)


def _neighbours(padded: torch.Tensor, rim: int, spacing: int) -> torch.Tensor:
    """All neighbours of each value inside a margin of `rim`, shape (neighbours, ...)."""
    sizes = [size - 2 * rim for size in padded.shape]
    steps = product(range(0, 2 * rim + 1, spacing), repeat=padded.ndim)
    return torch.stack(
        [
            padded[tuple(slice(i, i + n) for i, n in zip(step, sizes, strict=True))]
            for step in steps
            if any(i != rim for i in step)
        ]
    )


def _median(values: torch.Tensor) -> torch.Tensor:
    """Median over the first axis without NaN; the mean of the middle two of an even number.

    (torch.nanmedian takes the lower of the two, which biases a test with 8 neighbours.)
    """
    ranked = values.sort(dim=0).values  # NaN last
    number = (~torch.isnan(values)).sum(0, keepdim=True)
    middle = torch.cat([(number - 1).clamp(min=0) // 2, number // 2])
    return ranked.gather(0, middle.clamp(max=len(values) - 1)).mean(0)
