"""What a campaign's report says of many encounters: how far the aircraft rolls, and how often."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr

from lidar_mi.assessment.digits import percent, three, with_error
from lidar_mi.assessment.figures.campaign import draw_against, draw_distributions
from lidar_mi.assessment.figures.encounter import FLIGHTS
from lidar_mi.assessment.metrics.encounter import LEAST_REMOVED, fraction_added
from lidar_mi.assessment.metrics.encounter_hazard import ACCEPTED_BANK
from lidar_mi.assessment.report.block import Block


def encounter_blocks(metrics: Mapping[str, xr.DataArray]) -> Iterator[Block]:
    """Distribution of the largest bank angle of all flights, and the fraction below the limit."""
    rolls = {
        name: np.degrees(np.abs(metrics[f"encounter.{mode}.largest_roll"].values.ravel()))
        for mode, (name, *_) in FLIGHTS.items()
        if f"encounter.{mode}.largest_roll" in metrics
    }
    rolls = {name: values[np.isfinite(values)] for name, values in rolls.items()}
    rolls = {name: values for name, values in rolls.items() if values.size}
    if not rolls:
        return
    limit = math.degrees(ACCEPTED_BANK)
    text = "Largest bank angle of every flight: the fraction of flights that stay below. "
    below = [f"{name} {_fraction(values <= limit)}" for name, values in rolls.items()]
    text += f"Within {limit:.3g}°: {', '.join(below)}."
    label = "largest bank angle / °"
    panels = [draw_distributions("", rolls, label, limit)]
    off, *steered = rolls
    if off == FLIGHTS["off"][0] and steered and min(map(np.min, rolls.values())) > 0:
        against = {name: rolls[name] for name in steered}
        panels.append(draw_against(label, (off, rolls[off]), against, limit))
    yield Block("Bank angle", text, panels)
    added = _added(metrics)
    if added:
        yield Block("What the lidar adds", added, [])


def _added(metrics: Mapping[str, xr.DataArray]) -> str:
    """The verdict over all flights: sum and spread of what the lidar removes."""
    keys = [f"encounter.{mode}.largest_roll" for mode in ("autopilot", "feedforward", "perfect")]
    if not all(key in metrics for key in keys):
        return ""
    names = ("preview_from", "lead_time")
    nothing = xr.full_like(metrics[keys[0]], np.nan)
    rows = np.stack(
        [metrics[key].values.ravel() for key in keys]
        + [metrics.get(f"encounter.{name}", nothing).values.ravel() for name in names]
    )
    blind, ours, perfect, start, lead = rows[:, np.isfinite(rows[:3]).all(0)]
    if not blind.size:
        return ""
    least = LEAST_REMOVED["largest_roll"]
    fraction = fraction_added(blind, ours, perfect, least)
    judged = np.isfinite(fraction)
    limit = three(math.degrees(least))
    late, worse = int((lead < 0).sum()), int((ours > blind + least).sum())
    counts = (
        f"Of {blind.size} flights {int(np.isnan(start).sum())} never had a preview and {late} had "
        f"it too late, after the wake is felt; {worse} are worse than with the autopilot by more "
        f"than {limit} degrees. "
    )
    if not judged.any():
        return counts + (
            f"In no flight perfect preview removes {limit} degrees or more of the largest roll "
            "angle beyond the autopilot: there was nothing for the lidar to add."
        )
    gain, room = (blind - ours)[judged], (blind - perfect)[judged]
    total = float(gain.sum() / room.sum())
    text = (
        f"In {int(judged.sum())} of them perfect preview removes {limit} degrees or more of the "
        f"largest roll angle beyond the autopilot. Of this the lidar removes {percent(total)}"
    )
    if judged.sum() < 2:
        return counts + text + "."
    # ratio of sums: standard error by its linear residuals (Cochran 1977, 2.11)
    spread = np.std(gain - total * room, ddof=1)
    stderr = float(spread * np.sqrt(judged.sum()) / room.sum())
    low, middle, high = (float(q) for q in np.quantile(fraction[judged], [0.1, 0.5, 0.9]))
    return (
        counts
        + text
        + (
            f" in sum (standard error {percent(stderr)}), {percent(middle)} in the median flight, "
            f"{percent(low)} to {percent(high)} between the 10 % and the 90 % quantile, and "
            f"{percent(float(fraction[judged].min()))} in the worst."
        )
    )


def _fraction(met: np.ndarray) -> str:
    """Percentage with its standard error, by Laplace's rule so that none and all have one, too."""
    mean, count = met.mean(), met.size
    estimate = (met.sum() + 1) / (count + 2)
    return f"{with_error(100 * mean, 100 * np.sqrt(estimate * (1 - estimate) / count))} %"
