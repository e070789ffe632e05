"""Variances of roll and load by a control block, against those along rendered flights."""

import runpy
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

import lidar_mi as lm
from lidar_mi.encounter.control_block.block import control_block
from lidar_mi.encounter.control_block.losses import loss_chain
from lidar_mi.encounter.control_block.sensor_samples import SensorSamples, samples_of
from lidar_mi.encounter.slab_recorder import SlabRecorder
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.yaml import to_yaml
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import settings
from tests.support.markov_chain import chain

from .report import Check, Comparison, Row
from .scenes import Effort

TITLE = "Loops by control blocks"
INTRODUCTION = (
    "Rendered flights through turbulence, five in each of four airs. Of the flights in one air a "
    "control block is identified, which predicts the variances of roll, aileron and load factor of "
    "the loop of `examples/control_loop.py`. The same loop flies along the recorded estimates and "
    "the true wind. 0 to 5 % of the estimates are lost in addition, in runs of 3."
)

AIRS = {
    "1.5 m/s, 150 m": {"sigma": "1.5 m/s", "length": "150 m", "evolution": "frozen"},
    "3 m/s, 500 m": {"sigma": "3 m/s", "length": "500 m", "evolution": "frozen"},
    "severe": {"level": "severe", "evolution": "frozen"},
    "severe, sweeping": {"level": "severe", "evolution": "sweeping"},
}
FLIGHTS, LOSSES, RUN = 5, (0.0, 0.01, 0.03, 0.05), 3
DRAWS = 8
"""Of the losses, for each flight."""
SIGNALS = ("roll", "aileron", "load")
LOOP = Path(__file__).resolve().parents[1] / "examples" / "control_loop.py"


def _experiment(air: dict[str, str], seed: int) -> Experiment:
    return lm.load_experiment(
        "gust",
        seed=seed,
        wake={
            "vortex_pair": {"width": "60 m", "height": "40 m"},
            "texture": {"rms": 0.2, "outer_scale": "10 m"},
        },
        encounter={
            "air": {"wake": False, "gusts": [], "turbulence": air},
            "path": {"start": "450 m", "beyond": "500 m"},
            "control": {"mode": "feedforward", "preview": "wind", "latency": "0.12 s"},
        },
        render={"samples_per_beam": 16, "candidates": 16, "max_order": 1},
        retrieval={"stride": 8},
    )


def _flown(experiment: Experiment) -> SensorSamples:
    """What the lidar delivers on the nominal path."""
    encounter = encounter_of(experiment)
    path, period = encounter.path, 1 / encounter.rate
    lidar = lm.VirtualLidar(experiment)
    recorder = SlabRecorder(lidar)
    for number in range(
        int((path.start + path.beyond - encounter.look_ahead) / path.speed / period)
    ):
        recorder.add(lidar.step(number * period))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record = to_yaml({"experiment": settings(experiment), "versions": {}})
        (folder / "experiment.yaml").write_text(record)
        write_netcdf(recorder.dataset(), folder / "slabs.nc")
        write_netcdf(xr.Dataset(), folder / "flight.nc")
        return samples_of(folder)


def _with_losses(
    flights: list[SensorSamples], lost: float, random: np.random.Generator
) -> list[SensorSamples]:
    """Flights of which a fraction of the estimates is lost in runs, drawn several times."""
    if not lost:
        return flights
    begin = lost / RUN / (1 - lost)
    transition = np.array([[1 - begin, begin], [1 / RUN, 1 - 1 / RUN]])
    found = []
    for one in flights * DRAWS:
        received = chain(random, transition, len(one.estimate)) == 0
        found.append(replace(one, estimate=np.where(received, one.estimate, np.nan)))
    return found


def _ratios(
    flights: list[SensorSamples], with_losses: list[SensorSamples], hold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Variances in flight over predicted ones with the lidar, and without it, of `SIGNALS`.

    Filters and gusts are identified from every flight once, the chain of losses from all draws.
    """
    loop = runpy.run_path(str(LOOP))
    block = {name: values.values for name, values in control_block(flights).variables.items()}
    lost = [~np.isfinite(one.estimate[:, 1:]).all(axis=1) for one in with_losses]
    block["loss_transition"] = loss_chain(lost).transition
    found = []
    for forward in (1.0, 0.0):
        flown = loop["rms_in_flights"](block, with_losses, forward, hold)
        found.append((flown / loop["rms"](block, forward, hold)) ** 2)
    return found[0], found[1]


def of_rendered_flights(effort: Effort) -> Check:
    """Every air, with every fraction of losses and both replacements of a lost estimate."""
    lines: list[tuple[str, ...]] = []
    every: dict[tuple[float, float], list[np.ndarray]] = {}
    for air, keys in AIRS.items():
        flights = [_flown(_experiment(keys, seed + 1)) for seed in range(FLIGHTS * effort.scale)]
        known = np.mean([np.isfinite(one.estimate[:, 1:]).all(1).mean() for one in flights])
        for lost in LOSSES:
            for hold in (0.0, 1.0):
                random = np.random.default_rng([round(100 * lost), len(air)])
                some = _with_losses(flights, lost, random)
                lidar, without = _ratios(flights, some, hold)
                every.setdefault((lost, hold), []).append(lidar)
                lines.append(
                    (
                        air,
                        f"{100 * (1 - known):.1f} %",
                        f"{100 * lost:.0f} %",
                        "last value held" if hold else "announces nothing",
                        *(f"{value:.2f}" for value in (*lidar, *without[[0, 2]])),
                    )
                )
    rows = []
    for (lost, hold), found in every.items():
        of_airs = np.array(found)
        mean, spread = of_airs.mean(0), of_airs.std(0, ddof=1) / len(of_airs) ** 0.5
        way = "last value held" if hold else "announces nothing"
        rows += [
            Row(
                f"{signal}, {100 * lost:.0f} % lost, {way}",
                "predicted variance",
                1.0,
                mean[k],
                spread[k],
                0.1,
            )
            for k, signal in enumerate(SIGNALS)
        ]
    heads = (
        "air",
        "lost by itself",
        "lost in addition",
        "in place of a lost estimate",
        *(f"{signal}, with the lidar" for signal in SIGNALS),
        "roll, without",
        "load, without",
    )
    return Check(
        "Variance in flight over the predicted one",
        f"{FLIGHTS * effort.scale} flights of 11 s in each air. Images of 60 x 40 m, texture of "
        "20 %, 16 samples a beam in single scattering. Rows are means over the airs, with the "
        "standard error by their scatter.",
        tuple(rows),
        comparison=Comparison(heads, tuple(lines)),
    )


CHECKS = (of_rendered_flights,)
