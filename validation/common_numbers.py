"""Error of the wind by the simulation's own noise, with common and with independent numbers."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

from lidar_mi.experiment.run import finish, prepare
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import check, merged

from .report import Check, Comparison, Row
from .scenes import VARIANT, Effort

TITLE = "Common random numbers"
INTRODUCTION = (
    "Two images of 144 x 96 beams at 100 m, a pair of vortices of 150 m²/s, texture of 10 %, no "
    "detector, 16 samples a beam. The error by the simulation is the rms difference of v and w, "
    "over all vectors, from those of images of 256 samples with common numbers of another seed."
)

SAMPLES, REFERENCE = 16, 256
SEEDS = (1, 2, 3)
METHODS = ("variational", "multipass")
BASE = {
    "name": "common_numbers",
    "wake": {
        "vortex_pair": {
            "circulation": "150 m^2/s",
            "separation": "24 m",
            "core_radius": "2 m",
            "width": "71.5 m",
            "height": "47.5 m",
        },
        "spacing": "0.5 m",
        "texture": {"rms": 0.1, "outer_scale": "6 m"},
    },
    "platform": {"speed": "0 m/s", "dt": "0.1 s"},
    "scan": {"range": "100 m", "thickness": "2.5 m"},
    "lidar": {"fov_half": "10 mrad", "divergence_full": "2 mrad"},
    "render": {"variant": VARIANT},
    "retrieval": {"methods": METHODS, "stride": 4, "sources": "measured"},
}


def _air(extinction: float, orders: int) -> dict:
    """A medium extinction, /m, half of it around the wake, and the orders that are followed."""
    return {
        "wake": {
            "extinction": {"background": extinction / 2, "maximum": extinction, "molecules": 0}
        },
        "render": {"max_order": orders},
    }


AIRS = {
    "0.001 /m, one order": _air(0.001, 1),
    "0.01 /m, three orders": _air(0.01, 3),
    "0.05 /m, four orders": _air(0.05, 4),
}
RASTER = {"pattern": "raster", "duration": "50 ms"}
GEOMETRIES = {
    "platform at 100 m/s": {"platform": {"speed": "100 m/s"}},
    "scan of 50 ms through air that moves": {"scan": {"timing": RASTER, "air": "moving"}},
    "spherical gates": {"scan": {"gates": "spherical"}},
    "five gates": {"scan": {"gate_count": 5}},
    "pulse of 10 ns": {"lidar": {"pulse_duration": "10 ns"}},
}
LARGEST = {"0.05 /m, four orders": 0.07}
"""Error by the simulation that is wanted at most, m/s; 0.01 m/s elsewhere."""


def errors_of_the_wind(effort: Effort) -> Check:
    """Of both kinds of numbers, by air and by geometry."""
    cases = AIRS | {name: merged(_air(0.001, 1), keys) for name, keys in GEOMETRIES.items()}
    rows, lines = [], []
    for name, keys in cases.items():
        for method, own, common in _errors(keys):
            # of the mean over seeds
            sigma = np.std(common, ddof=1) / np.sqrt(len(common))
            got, allowed = np.mean(common), LARGEST.get(name, 0.01)
            lines.append((name, method, f"{np.mean(own):.3f}", f"{got:.4f}"))
            rows.append(Row(f"{name}, {method}", "goal", 0.0, got, sigma, allowed, "m/s"))
    return Check(
        "Error of the wind by the simulation",
        "Common numbers: the mean of three seeds, expected to be the tolerance at most. "
        "Independent numbers: one seed.",
        tuple(rows),
        comparison=Comparison(
            ("air or geometry", "method", "independent numbers, m/s", "common numbers, m/s"),
            tuple(lines),
        ),
    )


def _errors(keys: dict) -> Iterator[tuple[str, list[float], list[float]]]:
    """By method, rms errors of v and w by the simulation, m/s: independent and common numbers."""
    fine = _experiment(keys, "common", REFERENCE)
    # the same texture, wind and beams for all seeds
    known = dict(prepare(fine).results)
    best = _wind(fine, 1000, known)
    winds = {
        kind: [_wind(_experiment(keys, kind, SAMPLES), seed, known) for seed in seeds]
        for kind, seeds in (("independent", SEEDS[:1]), ("common", SEEDS))
    }
    for method in METHODS:
        own, common = (
            [_rms(wind.sel(algorithm=method), best.sel(algorithm=method)) for wind in found]
            for found in winds.values()
        )
        yield method, own, common


def _experiment(keys: dict, kind: str, samples: int) -> Experiment:
    render = {"render": {"random_numbers": kind, "samples_per_beam": samples}}
    return check(merged(merged(BASE, keys), render), "common_numbers")


def _wind(experiment: Experiment, seed: int, known: dict) -> xr.Dataset:
    run = prepare(experiment.model_copy(update={"seed": seed}), known=known)
    finish(run, with_figures=False)
    return run.wind.sel(source="backscatter")


def _rms(wind: xr.Dataset, best: xr.Dataset) -> float:
    squares = [((wind[name] - best[name]) ** 2).values for name in ("v", "w")]
    return float(np.sqrt(np.nanmean(squares)))


CHECKS = (errors_of_the_wind,)
