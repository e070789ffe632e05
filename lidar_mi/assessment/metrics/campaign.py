"""Numbers of a campaign: its dimensions, means over members, requirements, coverages.

A campaign's data set has the swept keys as dimensions, or a dimension ``sample`` with the keys as
coordinates; ``member`` if points were repeated with random numbers of their own.
"""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from lidar_mi.assessment.metrics.names import EXACT, RENDERED, vortex_key
from lidar_mi.assessment.metrics.vortices import Origin
from lidar_mi.errors import InputError

MEMBER, SAMPLE = "member", "sample"
LEVEL = 0.95
"""Confidence of all intervals."""

_MARGIN = re.compile(r"sensor\.(.+)\.([^.]+)\.([^.]+)\.margin")
_POINT = ("status", "message", "folder")


@dataclass(frozen=True)
class Interval:
    """Mean over members and its confidence interval; without members the interval is NaN."""

    mean: xr.DataArray
    low: xr.DataArray
    high: xr.DataArray


def knobs(dataset: xr.Dataset) -> list[str]:
    """Keys that differ between the points, in the order of the file."""
    if SAMPLE in dataset.dims:
        return [
            str(name)
            for name, at in dataset.coords.items()
            if at.dims == (SAMPLE,) and name != SAMPLE and len(np.unique(at)) > 1
        ]
    return [str(name) for name, size in dataset.sizes.items() if name != MEMBER and size > 1]


def is_numeric(dataset: xr.Dataset, knob: str) -> bool:
    """Whether a key has numbers, not labels."""
    return bool(np.issubdtype(dataset[knob].dtype, np.number))


def metrics_of(dataset: xr.Dataset) -> dict[str, xr.DataArray]:
    """All metrics by name, and errors of the vortices that follow from them.

    ``vortex.ORIGIN.error_circulation_5_15`` (m^2 s^-1) and ``error_position`` (m): rms error over
    both vortices of a point.
    """
    metrics = {str(name): array for name, array in dataset.items() if name not in _POINT}
    for origin in Origin:
        for name, parts, units in (
            ("circulation_5_15", ("circulation_5_15",), "m²/s"),
            ("position", ("y", "z"), "m"),
        ):
            keys = [f"{side}_{part}" for side in ("port", "starboard") for part in parts]
            pairs = [(vortex_key(origin, k), vortex_key("truth", k)) for k in keys]
            if all(key in metrics for pair in pairs for key in pair):
                squares = [(metrics[estimated] - metrics[true]) ** 2 for estimated, true in pairs]
                error = xr.concat(squares, "part", coords="minimal", compat="override")
                error = (error.sum("part", skipna=False) / 2) ** 0.5
                error.attrs = {"units": units, "long_name": f"error of {name}, {origin}"}
                metrics[vortex_key(origin, f"error_{name}")] = error
    return metrics


def chosen(metrics: Mapping[str, xr.DataArray], names: Sequence[str] | None) -> list[str]:
    """The metrics to show: those asked for, or errors, stated errors, vortices and pulses."""
    for key in names or ():
        if key not in metrics:
            near = ", ".join(difflib.get_close_matches(key, metrics, 3, 0.5))
            hint = f"; did you mean {near}?" if near else ""
            raise InputError(f"metrics: {key!r} is no metric of this campaign{hint}")
    if names:
        return list(dict.fromkeys(names))
    finite = {key for key, values in metrics.items() if np.isfinite(values).any()}
    best = _best_method(metrics, finite)
    vortex = [vortex_key(Origin.IMAGES, f"error_{q}") for q in ("circulation_5_15", "position")]
    combined = any(f"sensor.rmse_{name}" in finite for name in "uvw")
    head, components = ("sensor", "uvw") if combined else (best, "vw")
    defaults = [
        # each error with its coverage
        *(f"{head}.{what}_{name}" for name in components for what in ("rmse", "coverage_95")),
        *(() if head == "sensor" else (f"{best}.valid_fraction",)),
        # the part of it by Monte Carlo noise
        f"{best}.monte_carlo_w",
        *vortex,
        "sensor.rmse_v_los",
        "sensor.doppler.pulses_needed",
        "coherent.vortices.circulation_error",
        "coherent.vortices.place_error",
        "coherent.vortices.valid_fraction",
        *(f"coherent.winds.{what}_{name}" for name in "uvw" for what in ("rmse", "coverage_95")),
        *(
            f"encounter.{mode}.largest_roll"
            for mode in ("off", "autopilot", "feedforward", "perfect")
        ),
        "encounter.removed_beyond_autopilot.largest_roll",
        "encounter.lead_time",
        "encounter.normalised_innovation",
    ]
    present = [key for key in defaults if key in finite]
    return present or sorted(finite)[:8]


def _best_method(metrics: Mapping[str, xr.DataArray], finite: set[str]) -> str:
    """Source and method of the smallest median error of w; the most complete source that is."""
    for source in (*reversed(RENDERED), *EXACT):
        errors = {
            key.rpartition(".")[0]: float(metrics[key].median())
            for key in finite
            if re.fullmatch(rf"{source}\.\w+\.rmse_w", key)
        }
        if errors:
            return min(errors, key=errors.__getitem__)
    return ""


def over_members(values: xr.DataArray) -> Interval:
    """Mean over members; its interval by Student's t, which few members widen."""
    if MEMBER not in values.dims:
        unknown = xr.full_like(values, np.nan)
        return Interval(values, unknown, unknown)
    count = values.notnull().sum(MEMBER)
    mean = values.mean(MEMBER)
    # a single member has no spread
    several = count.where(count > 1)
    stderr = values.std(MEMBER, ddof=1).where(count > 1) / np.sqrt(several)
    half = stderr * scipy.stats.t.ppf((1 + LEVEL) / 2, several - 1)
    return Interval(mean, mean - half, mean + half)


def requirements(metrics: Mapping[str, xr.DataArray]) -> dict[tuple[str, str], dict[str, str]]:
    """Keys of the margins by (application, phase of flight), then quantity."""
    margins: dict[tuple[str, str], dict[str, str]] = {}
    for key in metrics:
        if match := _MARGIN.fullmatch(key):
            margins.setdefault((match[1], match[2]), {})[match[3]] = key
    return margins


def judged(dataset: xr.Dataset, key: str) -> xr.DataArray:
    """A margin; -1 where a finished run has no value to judge.

    NaN where the run is of another phase of flight.
    """
    margin, phase = dataset[key], key.rsplit(".", 2)[0]
    nothing = (dataset["status"] == 0) & margin.isnull()
    if f"{phase}.applies" in dataset:
        nothing &= dataset[f"{phase}.applies"] == 1
    return margin.where(~nothing, -1.0)


def spaced_by_factors(values: np.ndarray) -> bool:
    """Whether values are spaced evenly by factors, not by differences; of two, by 8 or more."""
    at = np.sort(np.asarray(values, dtype=float))
    if len(at) < 2 or at[0] <= 0:
        return False
    if len(at) == 2:
        return bool(at[1] >= 8 * at[0])
    linear, factors = (np.std(steps) / np.mean(steps) for steps in map(np.diff, (at, np.log(at))))
    return bool(factors < linear)


def varies_by_factors(values: np.ndarray) -> bool:
    """Whether all values are positive and the largest is 10 times the smallest or more."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() > 0 and finite.max() >= 10 * finite.min())


def met(margin: Interval) -> xr.DataArray:
    """1 where the mean margin is that of a requirement met, 0 where not, NaN where not known."""
    return (margin.mean >= 0).where(np.isfinite(margin.mean)).astype(float)


def undecided(margin: Interval) -> xr.DataArray:
    """Where the interval of the margin holds 0."""
    return (margin.low < 0) & (margin.high >= 0)


@dataclass(frozen=True)
class Boundary:
    """A value of a knob at which a requirement begins or ceases to be met.

    value, low, high: the knob, and its interval from that of the mean over members; NaN: not known,
        infinite: beyond the sweep.
    above: whether the requirement is met above the value.
    """

    value: float
    low: float
    high: float
    above: bool


def boundaries(margin: Interval, logarithmic: bool) -> list[Boundary]:
    """Where a margin along one knob changes its sign, between points linear in the knob's scale.

    margin: on one dimension with a coordinate in ascending or descending order.
    """
    (knob,) = margin.mean.dims
    order = np.argsort(margin.mean[knob].values)
    place = margin.mean[knob].values[order].astype(float)
    x = np.log(place) if logarithmic else place
    curves = [part.values[order] for part in (margin.mean, margin.low, margin.high)]
    boundaries = []
    ends = [_crossings(x, curve) for curve in curves[1:]]
    for value, above in _crossings(x, curves[0]):
        span = [math.nan, math.nan]
        if np.isfinite(curves[1]).any():
            # met above: the upper curve crosses first
            sides = (ends[1], ends[0]) if above else (ends[0], ends[1])
            before = [at for at, positive in sides[0] if positive == above and at <= value]
            after = [at for at, positive in sides[1] if positive == above and at >= value]
            span = [max(before, default=-math.inf), min(after, default=math.inf)]
        at, low, high = (
            math.exp(k) if logarithmic and math.isfinite(k) else k for k in (value, *span)
        )
        boundaries.append(Boundary(at, low, high, above))
    return boundaries


def _crossings(x: np.ndarray, y: np.ndarray) -> list[tuple[float, bool]]:
    """Zeros of a polyline and whether it is positive after them; gaps where it is not known."""
    crossings = []
    for k in range(len(x) - 1):
        a, b = y[k], y[k + 1]
        if np.isfinite([a, b]).all() and (a >= 0) != (b >= 0):
            crossings.append((float(x[k] + (x[k + 1] - x[k]) * a / (a - b)), bool(b >= 0)))
    return crossings


@dataclass(frozen=True)
class Coverage:
    """Fraction of errors of a quantity within the stated errors, over points and members."""

    quantity: str
    count: int
    within_68: float
    stderr_68: float
    within_95: float
    stderr_95: float


def coverages(metrics: Mapping[str, xr.DataArray]) -> list[Coverage]:
    """Coverages of winds and of vortex parameters, averaged over runs.

    Every run counts once. The standard error is that of the spread over members, which have
    independent errors, or over runs where there are no members.
    """
    rows = []
    for key, inner in metrics.items():
        head, name, component = key.rpartition(".coverage_68_")
        outer = f"{head}.coverage_95_{component}"
        if name and outer in metrics:
            rows.append(_coverage(f"{head}: {component}", inner, metrics[outer]))
    for origin in Origin:
        for key in metrics:
            quantity = key.removeprefix(vortex_key("truth", ""))
            value, stderr = (vortex_key(origin, f"{quantity}{end}") for end in ("", "_stderr"))
            if quantity != key and value in metrics and stderr in metrics:
                error = abs(metrics[value] - metrics[key]) / metrics[stderr]
                error = error.where(np.isfinite(error))
                within = [(error < k).where(error.notnull()).astype(float) for k in (1, 1.96)]
                rows.append(_coverage(f"vortex, {origin}: {quantity}", *within))
    return [row for row in rows if row.count]


def _coverage(quantity: str, inner: xr.DataArray, outer: xr.DataArray) -> Coverage:
    count = int(np.isfinite(inner).sum())
    numbers = [part for values in (inner, outer) for part in _mean_and_error(values)]
    return Coverage(quantity.replace("_", " "), count, *numbers)


def _mean_and_error(values: xr.DataArray) -> tuple[float, float]:
    unit = MEMBER if MEMBER in values.dims else None
    averaged = [dim for dim in values.dims if dim != unit]
    rows = (values.mean(averaged) if unit else values).values.ravel()
    rows = rows[np.isfinite(rows)]
    if not rows.size:
        return math.nan, math.nan
    error = float(rows.std(ddof=1) / math.sqrt(len(rows))) if len(rows) > 1 else math.nan
    return float(rows.mean()), error
