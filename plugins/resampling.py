"""One of several candidates, selected by contribution."""

from typing import Any, TypeAlias

import drjit as dr

from .variant_types import Float, Generator, Mask

Candidate: TypeAlias = tuple[Float, Float, tuple[Any, ...]]
"""The target value, to which its contribution should be proportional, the sum of the densities of
all candidates at its place, and its values, one of which is returned."""


def choose(rng: Generator, *candidates: Candidate) -> tuple[Any, Float]:
    """One of several candidates and its weight.

    Resampled importance sampling (Talbot et al. 2005), of candidates whose densities may differ:
    they share a place in proportion to these (balance heuristic; Veach & Guibas 1995).

    Returns the values of that candidate, and the weight that makes the choice unbiased.
    """
    (target, density, values), *others = candidates
    total = dr.select(target > 0, target / density, 0)
    for other_target, other_density, other_values in others:
        weight = dr.select(other_target > 0, other_target / other_density, 0)
        total += weight
        takes = rng.next_float32() * total < weight
        values = _either(takes, other_values, values)
        target = dr.select(takes, other_target, target)
    return values, dr.select(target > 0, total / target, 0)


def _either(condition: Mask, yes: Any, no: Any) -> Any:
    if isinstance(yes, list | tuple):
        return [_either(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return dr.select(condition, yes, no)
