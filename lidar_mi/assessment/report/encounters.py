"""What a campaign's report says of many encounters: how far the aircraft rolls, and how often."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr

from lidar_mi.assessment.digits import with_error
from lidar_mi.assessment.figures.campaign import draw_against, draw_distributions
from lidar_mi.assessment.figures.encounter import FLIGHTS
from lidar_mi.assessment.metrics.encounter_hazard import ACCEPTED_BANK
from lidar_mi.assessment.report.block import Block


def encounter_blocks(known: Mapping[str, xr.DataArray]) -> Iterator[Block]:
    """Distribution of the largest bank angle of all flights, and the fraction below the limit."""
    rolls = {
        name: np.degrees(np.abs(known[f"encounter.{mode}.largest_roll"].values.ravel()))
        for mode, (name, *_) in FLIGHTS.items()
        if f"encounter.{mode}.largest_roll" in known
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


def _fraction(met: np.ndarray) -> str:
    """Percentage with its standard error, by Laplace's rule so that none and all have one, too."""
    mean, count = met.mean(), met.size
    ruled = (met.sum() + 1) / (count + 2)
    return f"{with_error(100 * mean, 100 * np.sqrt(ruled * (1 - ruled) / count))} %"
