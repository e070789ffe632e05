"""Staggered and stretched grids of flow solvers, interpolated to even axes with an error."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

# Largest deviation of a step from the mean step, in steps: float32 axes a few kilometres from
# their origin reach 5e-4.
_UNEVEN = 1e-3
# Largest ratio of the nodes of an even axis to those of a stretched one.
_DENSEST = 4


def is_even(nodes: np.ndarray) -> bool:
    """Whether an ascending axis has equal steps, up to single precision."""
    steps = np.diff(nodes)
    return steps.size == 0 or bool(np.ptp(steps) <= 2 * _UNEVEN * steps.mean())


def even_axis(nodes: np.ndarray, low: float, high: float) -> np.ndarray:
    """An even axis (m) within the ends that all variables have.

    An axis that is even keeps its nodes. A stretched one gets the largest step of 1, 2 or 5 times a
    power of ten that is not above its smallest step, but not more than four times the nodes, on
    whole multiples of it, and on whole metres where it is longer than 20 m.
    """
    if is_even(nodes):
        exact = np.linspace(nodes[0], nodes[-1], nodes.size)
        slack = _UNEVEN * _step(nodes)
        return exact[(exact >= low - slack) & (exact <= high + slack)]
    least = max(float(np.diff(nodes).min()), (high - low) / (_DENSEST * nodes.size))
    power = 10.0 ** math.floor(math.log10(least))
    step = max(n * power for n in (1, 2, 5) if n * power <= least * (1 + 1e-9))
    multiple = 1.0 if high - low > 20 and step < 1 else step
    first, last = math.ceil(low / multiple - 1e-9), math.floor(high / multiple + 1e-9)
    return np.linspace(
        first * multiple, last * multiple, round((last - first) * multiple / step) + 1
    )


def interpolated(
    values: np.ndarray, nodes: Sequence[np.ndarray], targets: Sequence[np.ndarray]
) -> tuple[np.ndarray, float]:
    """Values at other nodes by cubic splines, axis by axis, and how well they are determined.

    values (n0, n1, ...)
    nodes, targets (sequences of arrays): for every axis, ascending. An axis with equal nodes and
        targets is left as it is.

    Returns
    -------
    values : array
    error : float
        Root mean square of the difference from linear interpolation. Where the grid resolves the
        flow, the spline's error is smaller. 0: nothing was interpolated.
    """
    smooth, straight = values, values
    for axis, (old, new) in enumerate(zip(nodes, targets, strict=True)):
        if old.size == new.size and np.allclose(old, new, rtol=0, atol=1e-3 * _step(old)):
            continue
        smooth = scipy.interpolate.CubicSpline(old, smooth, axis=axis)(new)
        straight = scipy.interpolate.make_interp_spline(old, straight, k=1, axis=axis)(new)
    return smooth, float(np.sqrt(np.mean((smooth - straight) ** 2)))


def statement(errors: Mapping[str, float], units: Mapping[str, str]) -> str:
    """A sentence on the interpolated variables and their errors; empty without any."""
    parts = [
        f"{name} to {error:.2g} {units[name]}".rstrip() for name, error in errors.items() if error
    ]
    return f"interpolated to an even grid: {', '.join(parts)} (rms)" if parts else ""


def _step(nodes: np.ndarray) -> float:
    return float(np.diff(nodes).min()) if nodes.size > 1 else 1.0
