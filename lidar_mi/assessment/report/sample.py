"""What a campaign's report says of a space-filling sample: indices, scatter, Pareto front."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr
from scipy import stats

from lidar_mi.assessment.digits import percent
from lidar_mi.assessment.figures import campaign as figures
from lidar_mi.assessment.figures.campaign import Axis, Points
from lidar_mi.assessment.metrics import campaign as numbers
from lidar_mi.assessment.metrics.campaign import SAMPLE, Interval
from lidar_mi.assessment.metrics.pareto import pareto_front
from lidar_mi.assessment.metrics.sensitivity import SobolIndices, sobol_indices
from lidar_mi.assessment.report.block import Block, label_of

# Further objectives of a Pareto front than the error: key, whether larger is better.
_OBJECTIVES = (
    ("lidar.pulse_energy", False),
    ("scan.range", True),
    ("render.samples_per_beam", False),
)


def sample_blocks(
    dataset: xr.Dataset,
    metrics: Mapping[str, xr.DataArray],
    keys: Sequence[str],
    axes: Mapping[str, Axis],
    points: Points,
) -> Iterator[Block]:
    """Sobol' indices and scatter of every metric, then the Pareto front of every error."""
    logarithmic = [name for name, axis in axes.items() if axis.logarithmic]
    labels = {name: axis.label.partition(" / ")[0] for name, axis in axes.items()}
    places = {name: dataset[name].values for name in axes}
    for key in keys:
        values = metrics[key].transpose(SAMPLE, ...)
        label, mean = label_of(values, key), numbers.over_members(values).mean.values
        title, text, drawn = label.partition(" / ")[0], "", []
        y = Axis(key, label, False)
        if places:
            # errors vary by factors: so does their surrogate
            factors = numbers.varies_by_factors(values.values)
            analysed = np.log10(values.values) if factors else values.values
            indices = sobol_indices(places, analysed, logarithmic)
            text = ("Of its logarithm. " if factors else "") + _sensitivity_text(indices)
            if indices.determined:
                drawn.append(figures.draw_indices("Sobol' indices", indices, labels, title))
        for name, axis in axes.items():
            drawn.append(figures.draw_scatter("", axis, places[name], y, mean, points))
        yield Block(title, f"{text} Key: {key}.", drawn)
    for key in keys:
        if "rmse_" in key:
            yield from _fronts(key, metrics, axes, places, points)


def _fronts(
    key: str,
    metrics: Mapping[str, xr.DataArray],
    axes: Mapping[str, Axis],
    places: Mapping[str, np.ndarray],
    points: Points,
) -> Iterator[Block]:
    varied = [(name, larger) for name, larger in _OBJECTIVES if name in axes]
    if not varied:
        return
    values = numbers.over_members(metrics[key].transpose(SAMPLE, ...)).mean.values
    objectives = np.stack([values, *(places[name] for name, _ in varied)], axis=1)
    front = pareto_front(objectives, [False, *(larger for _, larger in varied)])
    label = label_of(metrics[key], key)
    y = Axis(key, label, False)
    better = ", ".join(
        f"{'larger' if larger else 'smaller'} {axes[name].label.partition(' / ')[0]}"
        for name, larger in varied
    )
    text = (
        f"{int(front.sum())} of {int(np.isfinite(values).sum())} points (orange) are not improved "
        f"on in everything at once. Better: smaller {label.partition(' / ')[0]}, {better}."
    )
    if len(varied) > 1:
        text += " The lines are the fronts of error and one knob alone."
    drawn = []
    for name, larger in varied:
        pair = pareto_front(np.stack([values, places[name]], axis=1), [False, larger])
        drawn.append(
            figures.draw_scatter("", axes[name], places[name], y, values, points, front, pair)
        )
    yield Block(f"Pareto front, {label.partition(' / ')[0]}", text, drawn)


def margin_blocks(
    dataset: xr.Dataset,
    margins: Mapping[tuple[str, str], Mapping[str, Interval]],
    axes: Mapping[str, Axis],
    points: Points,
) -> Iterator[Block]:
    """Where in the sample requirements are met, in the plane of the two knobs that decide."""
    numeric = [name for name, axis in axes.items() if not axis.labels]
    if len(numeric) < 2 or not margins:
        return
    places = {name: dataset[name].values for name in numeric}
    drawn = []
    for (application, phase), rows in margins.items():
        of_rows = np.stack([margin.mean.transpose(SAMPLE).values for margin in rows.values()])
        worst = of_rows.min(0)  # NaN where any row has no value
        x, y = sorted(_decisive(places, worst), key=numeric.index)
        title = f"{application.replace('_', ' ')}, {phase}"
        drawn.append(
            figures.draw_margins(title, worst, axes[x], places[x], axes[y], places[y], points)
        )
    text = (
        "Every point of the sample, in the plane of the two knobs with which the smallest margin "
        "of all rows rises or falls most (Spearman's rank correlation)."
    )
    yield Block("Where all rows are met", text, drawn)


def _decisive(places: Mapping[str, np.ndarray], values: np.ndarray) -> list[str]:
    """The two knobs of largest rank correlation with values; the first ones where none has any."""
    finite = np.isfinite(values)
    if finite.sum() < 3 or np.ptp(values[finite]) == 0:
        return list(places)[:2]
    strength = {
        name: abs(stats.spearmanr(at[finite], values[finite]).statistic)
        for name, at in places.items()
    }
    return sorted(strength, key=lambda name: -np.nan_to_num(strength[name]))[:2]


def _sensitivity_text(indices: SobolIndices) -> str:
    between_members = (
        ""
        if np.isnan(indices.between_members)
        else f" Members of a point differ by {percent(indices.between_members)} of it."
    )
    if not indices.determined:
        return f"Sobol' indices are undetermined: {indices.reason}.{between_members}"
    unexplained = max(0.0, 1 - indices.explained)
    return (
        f"Sobol' indices with 95 % intervals, from {indices.points} points. The knobs explain "
        f"{percent(indices.explained)} of the variance (cross-validated Q²); "
        f"{percent(unexplained)} is random or too sharp for so few points.{between_members}"
    )
