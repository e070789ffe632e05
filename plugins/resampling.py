"""One of two candidates, selected by contribution."""

import drjit as dr


def choose(rng, first, second):
    """One of two candidates and its weight (resampled importance sampling, Talbot et al. 2005).

    A candidate is its target value, to which its contribution should be proportional, its density,
    and the values to return.
    """
    (target, density, one), (other_target, other_density, other) = first, second
    weight = dr.select(target > 0, target / density, 0)
    other_weight = dr.select(other_target > 0, other_target / other_density, 0)
    total = weight + other_weight
    second_chosen = rng.next_float32() * total >= weight
    target = dr.select(second_chosen, other_target, target)
    return _either(second_chosen, other, one), dr.select(target > 0, 0.5 * total / target, 0)


def _either(condition, yes, no):
    if isinstance(yes, list | tuple):
        return [_either(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return dr.select(condition, yes, no)
