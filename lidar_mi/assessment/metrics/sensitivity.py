"""Which knob matters: Sobol' indices of a metric over a sample of a design space.

The sample may be of any design. A Gaussian process is fitted to it; the estimators of Saltelli and
Jansen are applied to draws of functions that agree with the sample, hence the confidence intervals.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc
from scipy.stats import sobol_indices as scipy_indices

from lidar_mi.assessment.metrics.surrogate import Array, Process, processes
from lidar_mi.errors import InputError

LEAST_EXPLAINED = 0.5
"""Cross-validated fraction of the variance below which indices count as undetermined."""

# A process needs some points for each of its correlation lengths.
_POINTS_PER_KNOB = 8
# Draws of hyperparameters, functions of each, rows of Saltelli's matrices.
_PROCESSES, _FUNCTIONS, _SALTELLI = 12, 16, 1024
# Functions of the process are smoother than some metrics. Intervals are widened by this and by this
# fraction of the unexplained variance: then they contain the indices of the test functions of
# Ishigami and Sobol' at 256 points, with and without noise.
_RESOLUTION, _MISSED = 0.01, 0.25


@dataclass(frozen=True)
class SobolIndices:
    """Fractions of a metric's variance over a design space, by knob.

    first, total (knob,): first-order and total indices, of the part of the metric that is a
        function of the knobs; NaN where they are undetermined.
    first_interval, total_interval (knob, 2): 95 % confidence intervals.
    explained: Q2: fraction of the variance over the points that is predicted by the others
        (leave-one-out). The remainder is random, or a dependence too sharp for so few points.
    between_members: fraction of the variance of single members that is between members of the same
        point; NaN without members.
    points: with a value.
    reason: why the indices are undetermined; empty if they are not.
    """

    knobs: tuple[str, ...]
    first: Array
    total: Array
    first_interval: Array
    total_interval: Array
    explained: float
    between_members: float
    points: int
    reason: str

    @property
    def determined(self) -> bool:
        """Whether there are indices; if not, see `reason`."""
        return not self.reason


def unit_cube(knobs: Mapping[str, ArrayLike], logarithmic: Sequence[str] = ()) -> Array:
    """Knobs mapped to 0 ... 1 by their range in the sample, (point, knob).

    Raises InputError: knobs of different lengths, a value that is not finite, a logarithmic knob
    with a value that is not positive, a knob that does not vary.
    """
    columns = []
    for name, samples in knobs.items():
        values = np.asarray(samples, dtype=float)
        if name in logarithmic:
            if not (values > 0).all():
                raise InputError(f"{name}: {values.min()} is not allowed; expected more than 0")
            values = np.log(values)
        if values.ndim != 1 or not np.isfinite(values).all() or not np.ptp(values) > 0:
            raise InputError(f"{name}: not allowed; expected finite numbers that vary, one a point")
        columns.append((values - values.min()) / np.ptp(values))
    if len({len(column) for column in columns}) != 1:
        raise InputError(f"{', '.join(knobs)}: expected values of the same number of points")
    return np.stack(columns, axis=1)


def sobol_indices(
    knobs: Mapping[str, ArrayLike],
    values: ArrayLike,
    logarithmic: Sequence[str] = (),
    seed: int = 0,
) -> SobolIndices:
    """First-order and total Sobol' indices of a metric, from a sample of its values.

    The knobs are independent and uniform (or uniform in their logarithm) between the smallest and
    the largest of the sample.

    knobs (point,)
    values (array (point,) or (point, member)): the metric. NaN: no value. The mean over the members
        of a point is analysed.
    logarithmic: knobs that were sampled in their logarithm.

    Raises InputError: see `unit_cube`; also values of another number of points.

    Notes
    -----
    Gaussian process with a Matern 5/2 kernel, a correlation length per knob and noise, by maximum
    marginal likelihood (Rasmussen & Williams 2006, chapters 2 and 5). The intervals are those of
    indices of functions drawn from the process given the sample (Le Gratiet, Cannamela & Iooss
    2014), the hyperparameters drawn from a normal approximation about their maximum.
    """
    cube, table = unit_cube(knobs, logarithmic), np.asarray(values, dtype=float)
    if len(table) != len(cube):
        raise InputError(f"values: {len(table)} are not allowed; expected {len(cube)}, one a point")
    table = np.where(np.isfinite(table), table, np.nan).reshape(len(table), -1)
    finite = np.isfinite(table).any(axis=1)
    cube, table = cube[finite], table[finite]
    count, needed = len(table), _POINTS_PER_KNOB * len(knobs)
    unknown, interval = np.full(len(knobs), np.nan), np.full((len(knobs), 2), np.nan)
    fraction = _member_fraction(table)
    none = SobolIndices(
        tuple(knobs), unknown, unknown, interval, interval, np.nan, fraction, count, reason=""
    )
    if count < needed:
        few = f"{count} points with a value; {needed} are needed for {len(knobs)} knobs"
        return replace(none, reason=few)
    mean = np.nanmean(table, axis=1)
    # the rounding error of a difference of equal numbers is no variance
    if not np.ptp(mean) > 1e-12 * np.abs(mean).max():
        return replace(none, reason="it does not vary")
    scaled = (mean - mean.mean()) / mean.std()
    rng = np.random.default_rng(seed)
    drawn = processes(cube, scaled, _PROCESSES, rng)
    explained = _explained(scaled, np.mean([process.without_each() for process in drawn], axis=0))
    if explained < LEAST_EXPLAINED:
        poor = (
            f"the other points predict {100 * max(explained, 0.0):.0f} % of the variance of a "
            f"point, less than {100 * LEAST_EXPLAINED:.0f} %: random, or too few points"
        )
        return replace(none, explained=explained, reason=poor)
    first, total = _index_draws(drawn, rng)
    missed = _RESOLUTION + _MISSED * (1 - explained)
    return replace(
        none,
        first=np.median(first, axis=1),
        total=np.median(total, axis=1),
        first_interval=_interval(first, missed),
        total_interval=_interval(total, missed),
        explained=explained,
    )


def _interval(draws: Array, missed: float) -> Array:
    low, high = np.quantile(draws, (0.025, 0.975), axis=1)
    return np.clip(np.stack([low - missed, high + missed], axis=1), 0.0, 1.0)


def _member_fraction(table: Array) -> float:
    repeated = np.isfinite(table).sum(axis=1) > 1
    if not repeated.any():
        return np.nan
    within = np.nanvar(table[repeated], axis=1, ddof=1).mean()
    return float(min(1.0, within / np.nanvar(table)))


def _explained(values: Array, predicted: Array) -> float:
    """Q2 of values of mean 0; a mean without the point is also worse than the mean of all."""
    alone = values * len(values) / (len(values) - 1)
    return float(1 - ((values - predicted) ** 2).sum() / (alone**2).sum())


def _index_draws(drawn: Sequence[Process], rng: np.random.Generator) -> tuple[Array, Array]:
    """First-order and total indices (knob, draw) of functions that agree with the sample."""
    first, total = [], []
    knobs = drawn[0].points.shape[1]
    for process in drawn:
        pairs = qmc.Sobol(2 * knobs, seed=rng).random(_SALTELLI)
        a, b = pairs[:, :knobs], pairs[:, knobs:]
        # A with one column at a time replaced by that of B
        mixed = np.where(np.eye(knobs, dtype=bool)[:, None], b, a)
        places = np.concatenate([a, b, *mixed])
        functions = process.functions(places, _FUNCTIONS, rng).T
        f_a, f_b, f_ab = np.split(functions, (_SALTELLI, 2 * _SALTELLI), axis=1)
        f_ab = f_ab.reshape(_FUNCTIONS, knobs, _SALTELLI).swapaxes(0, 1)
        indices = scipy_indices(func={"f_A": f_a, "f_B": f_b, "f_AB": f_ab}, n=_SALTELLI)
        first.append(indices.first_order.T)
        total.append(indices.total_order.T)
    return np.concatenate(first, axis=1), np.concatenate(total, axis=1)
