"""One of two candidates, selected by contribution."""

from typing import Any, TypeAlias

import drjit as dr

from .variant_types import Float, Generator, Mask

Candidate: TypeAlias = tuple[Float, Float, tuple[Any, ...]]
"""The target value, to which its contribution should be proportional, its density, and its values,
one of which is returned."""


def choose(rng: Generator, first: Candidate, second: Candidate) -> tuple[list[Any], Float]:
    """One of two candidates and its weight (resampled importance sampling, Talbot et al. 2005).

    Returns the values of that candidate, and the weight that makes the choice unbiased.
    """
    (target, density, one), (other_target, other_density, other) = first, second
    weight = dr.select(target > 0, target / density, 0)
    other_weight = dr.select(other_target > 0, other_target / other_density, 0)
    total = weight + other_weight
    second_chosen = rng.next_float32() * total >= weight
    target = dr.select(second_chosen, other_target, target)
    return _either(second_chosen, other, one), dr.select(target > 0, 0.5 * total / target, 0)


def _either(condition: Mask, yes: Any, no: Any) -> Any:
    if isinstance(yes, list | tuple):
        return [_either(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return dr.select(condition, yes, no)
