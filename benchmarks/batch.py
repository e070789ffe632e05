"""Pairs of images retrieved side by side (`retrieve_winds`), against one after the other."""

import os

import numpy as np
import torch
import xarray as xr

from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.series import retrieve_winds

from .cases import DT, vortex_pair_images
from .measure import in_turns
from .report import Comparison, row

METHODS = ("variational", "multipass", "cc")
NOISE = 0.02
WINDOWS = WindowSizes(stride=4)


def compare(repeats: int = 5, columns: int = 219, rows: int = 139, pairs: int = 8) -> Comparison:
    """Wall time of a pair, and the largest difference of the winds."""
    seen = [vortex_pair_images(NOISE, seed, columns, rows) for seed in range(1, pairs + 1)]
    stack = xr.concat([image for pair in seen for image in (pair.first, pair.second)], "image")
    chosen = [(2 * k, 2 * k + 1) for k in range(pairs)]
    lines = []
    for method in METHODS:
        found = in_turns(
            {
                "together": lambda _, method=method: retrieve_winds(
                    stack, DT, chosen, method=method, windows=WINDOWS, noise=NOISE
                ),
                "alone": lambda _, method=method: [
                    retrieve_wind(p.first, p.second, DT, method, windows=WINDOWS, noise=NOISE)
                    for p in seen
                ],
            },
            repeats,
        )
        ours, other = ([timed.seconds / pairs for timed in found[side]] for side in found)
        together, alone = (found[side][0].result for side in found)
        off = max(
            float(np.nanmax(abs(one[name].values - together[name].values[k])))
            for k, one in enumerate(alone)
            for name in "vw"
        )
        note = f"winds differ by at most {off:.0e} m/s"
        lines.append(row(f"{method}", "time of a pair", "s", ours, other, "lower", note))
    return Comparison(
        f"{pairs} pairs of {columns} x {rows} px at once",
        f"{torch.get_num_threads()} threads",
        "one thread",
        tuple(lines),
        (f"{os.cpu_count()} cores. One after the other a small image has one thread.",),
    )
