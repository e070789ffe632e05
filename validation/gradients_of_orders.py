"""Gradients of all orders against differences of images with the same random numbers."""

import math

import numpy as np
from scipy.stats import norm

from . import gradient_reference as reference
from .gradient_reference import COLUMNS, GATES, MEDIUM, SHAPE
from .report import Check, Row

KEY = f"{MEDIUM}.sigma_t.data"
DEPTHS = (0.1, 1.0, 3.0)
PLACES = [(*place, 0) for place in np.ndindex(SHAPE)][1::3]
SAMPLES, SEEDS = 500, 12
OF_DIFFERENCES = 12
"""Times the samples: one seed, and more noise."""
STEP, WHOLE = 0.05, 0.02
"""Of differences, relative: of a voxel, of all."""


def orders(effort):
    """Extinction of a slab and of its voxels, order by order."""
    rows = []
    for varied in (False, True):
        for depth in DEPTHS:
            rows += _rows(depth, varied, effort.scale)
    places = 2 * len(DEPTHS) * len(PLACES)
    return Check(
        "Gradients of all orders",
        "A slab of 30 m, voxels of 5 to 6 m, molecules with an albedo of 0.9, elliptically "
        "polarised light, a field of view of 12 mrad, three orders of scattering. Relative change "
        "of each order's light with the extinction of the whole slab; and, for "
        f"{places} voxels in all, differences between gradients and central differences as normal "
        "scores, of S0 of each order and of the polarised components of all orders: their rms, "
        "whose error is that of a quarter as many independent scores, and the largest one.",
        tuple(rows),
    )


def _rows(depth: float, varied: bool, scale: int) -> list[Row]:
    values = reference.extinction(depth, varied)
    loaded, grid = reference.loaded(values), values[..., None]
    steps = reference.steps(grid.shape, [(place, STEP * grid[place]) for place in PLACES])
    directions = np.concatenate([WHOLE * grid[None], steps])
    samples = SAMPLES * scale
    light = reference.light(loaded, OF_DIFFERENCES * samples, 2)
    expected = reference.by_differences(loaded, KEY, directions, OF_DIFFERENCES * samples, 1)
    found = reference.by_replay(loaded, KEY, directions, samples, range(100, 100 + SEEDS))
    name = f"optical depth {depth:g}, {'varied' if varied else 'uniform'}"
    rows = []
    for gate, where in enumerate(GATES):
        for column, what in enumerate(COLUMNS[:3]):
            unit = WHOLE * light[gate, column]
            errors = found.errors[0, gate, column], expected.errors[0, gate, column]
            rows.append(
                Row(
                    f"{name}, {where}: d ln S0 / d ln E, {what}",
                    "central differences",
                    expected.values[0, gate, column] / unit,
                    found.values[0, gate, column] / unit,
                    math.hypot(*errors) / unit,
                )
            )
    scores = reference.scores(found.of(slice(1, None)), expected.of(slice(1, None)))
    number = scores.size
    likely = norm.isf(0.5 * (1 - 0.5 ** (1 / number)))
    most = norm.isf(0.5 * (1 - 0.9999 ** (1 / number)))
    rows += [
        Row(
            f"{name}: rms of {number} scores",
            "normal distribution",
            1.0,
            np.sqrt(np.mean(scores**2)),
            math.sqrt(2 / number),
        ),
        Row(
            f"{name}: largest of {number} scores",
            "normal distribution, median",
            likely,
            np.abs(scores).max(),
            tolerance=most - likely,
        ),
    ]
    return rows
