"""What a campaign's report says of a space-filling sample: indices, scatter, Pareto front."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.figures import campaign as figures
from lidar_mi.assessment.figures.campaign import Axis, Points
from lidar_mi.assessment.metrics import campaign as numbers
from lidar_mi.assessment.metrics.campaign import SAMPLE
from lidar_mi.assessment.metrics.pareto import pareto_front
from lidar_mi.assessment.metrics.sensitivity import SobolIndices, sobol_indices
from lidar_mi.assessment.report.block import Block, label_of
from lidar_mi.assessment.report.digits import percent

# Objectives of a Pareto front beside the error: key, whether larger is better.
_OBJECTIVES = (
    ("lidar.pulse_energy", False),
    ("scan.range", True),
    ("render.samples_per_beam", False),
)


def sample_blocks(
    dataset: xr.Dataset,
    known: Mapping[str, xr.DataArray],
    shown: Sequence[str],
    axes: Mapping[str, Axis],
    points: Points,
) -> Iterator[Block]:
    """Sobol' indices and scatter of every metric, then the Pareto front of the first error."""
    logarithmic = [name for name, axis in axes.items() if axis.logarithmic]
    labels = {name: axis.label.partition(" / ")[0] for name, axis in axes.items()}
    places = {name: dataset[name].values for name in axes}
    for key in shown:
        values = known[key].transpose(SAMPLE, ...)
        label, mean = label_of(values, key), numbers.over_members(values).mean.values
        title, text, drawn = label.partition(" / ")[0], "", []
        y = Axis(key, label, False)
        if places:
            # errors vary by factors: so does their surrogate
            factors = numbers.varies_by_factors(values.values)
            analysed = np.log10(values.values) if factors else values.values
            found = sobol_indices(places, analysed, logarithmic)
            text = ("Of its logarithm. " if factors else "") + _sensitivity_text(found)
            if found.determined:
                drawn.append(figures.draw_indices("Sobol' indices", found, labels))
        for name, axis in axes.items():
            drawn.append(figures.draw_scatter("", axis, places[name], y, mean, points))
        yield Block(title, f"{text} Key: {key}.", drawn)
    errors = [key for key in shown if "rmse_" in key][:1]
    for key in errors:
        yield from _fronts(key, known, axes, places, points)


def _fronts(key, known, axes, places, points) -> Iterator[Block]:
    varied = [(name, larger) for name, larger in _OBJECTIVES if name in axes]
    if not varied:
        return
    values = numbers.over_members(known[key].transpose(SAMPLE, ...)).mean.values
    objectives = np.stack([values, *(places[name] for name, _ in varied)], axis=1)
    front = pareto_front(objectives, [False, *(larger for _, larger in varied)])
    label = label_of(known[key], key)
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
    yield Block("Pareto front", text, drawn)


def _sensitivity_text(found: SobolIndices) -> str:
    luck = (
        ""
        if np.isnan(found.luck)
        else f" Luck (members of a point) is {percent(found.luck)} of it."
    )
    if not found.determined:
        return f"Sobol' indices are undetermined: {found.reason}.{luck}"
    left = max(0.0, 1 - found.explained)
    return (
        f"Sobol' indices with 95 % intervals, from {found.points} points. The knobs explain "
        f"{percent(found.explained)} of the variance (cross-validated Q²); {percent(left)} is luck "
        f"or too sharp for so few points.{luck}"
    )
