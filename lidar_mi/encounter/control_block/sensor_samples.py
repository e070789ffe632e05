"""What a flight's lidar delivered, beside the wind that the wing meets: slab by slab."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.encounter.control_block.gust_axes import GUSTS, gusts, span_nodes
from lidar_mi.errors import InputError
from lidar_mi.experiment.export_flight import FLIGHT_FILES
from lidar_mi.experiment.folder.records import RECORD, read_record
from lidar_mi.experiment.truth.flight_air import air_along_path
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.io.netcdf import read_netcdf
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import check

MARGIN = 8
"""Planes before and after those of a flight in which the wind is known."""


@dataclass(frozen=True, eq=False)
class SensorSamples:
    """Gusts of consecutive slabs of one flight: true, and as estimated.

    period: from slab to slab, s.
    speed, span: of the aircraft, m/s and m.
    distance: of a slab when it is scanned for the first time, m.
    delay: from this scan to the delivery, s.
    truth, estimate (slabs, 4): along `GUSTS` of `gust_axes`. The truth is that of the plane when
        the wing arrives on the nominal path; NaN where nothing was estimated.
    truth_before, truth_after (`MARGIN`, 4): in the planes before and after.
    roll_moment_per_gust: rolling moment per roll gust, N m s/rad.
    lift_per_gust: force upwards per w, N s/m.
    """

    period: float
    speed: float
    span: float
    distance: float
    delay: float
    truth: np.ndarray
    estimate: np.ndarray
    truth_before: np.ndarray
    truth_after: np.ndarray
    roll_moment_per_gust: float
    lift_per_gust: float


def flights_in(folder: str | Path) -> list[Path]:
    """Folders of finished flights with a lidar: this one, or those below it."""
    folder = Path(folder)
    needed = (RECORD, FLIGHT_FILES["series"], FLIGHT_FILES["slabs"])
    files = sorted(
        path.parent
        for path in (folder, *folder.rglob("*/"))
        for path in [path / RECORD]
        if all((path.parent / name).is_file() for name in needed)
    )
    if not files:
        raise InputError(
            f"{folder}: holds no finished flight with the lidar; expected the folder of lidar-mi "
            "fly --mode feedforward, or of a campaign of flights with keep: everything"
        )
    return files


def samples_of(folder: Path) -> SensorSamples:
    """The slabs of a flight.

    Raises InputError: a folder without a flight, or one whose slabs have no wind vectors.
    """
    marker = folder / RECORD
    experiment = check(read_record(folder)["experiment"], str(marker)).read_from(folder)
    encounter = encounter_of(experiment)
    slabs = read_netcdf(folder / FLIGHT_FILES["slabs"])
    if "w" not in slabs:
        raise InputError(
            f"{folder}: the slabs have no wind vectors; expected a flight whose "
            "retrieval.methods estimates the wind, such as variational"
        )
    speed, period = encounter.path.speed, 1 / encounter.rate
    aircraft = aircraft_of(encounter)
    roll_only = encounter.aircraft.model == "roll"
    span = encounter.aircraft.span if roll_only else float(np.ptp(aircraft.strips.places[:, 1]))
    lift = 0.5 * aircraft.density * speed
    lift *= float(
        (aircraft.strips.areas * aircraft.strips.slopes * aircraft.strips.normals[:, 2] ** 2).sum()
    )
    number = np.round((slabs["x"].values - float(slabs["x"][0])) / (speed * period)).astype(int)
    count = int(number[-1]) + 1
    planes = float(slabs["x"][0]) + speed * period * np.arange(-MARGIN, count + MARGIN)
    truth = true_gusts(experiment, planes, span)
    estimate = np.full((count, len(GUSTS)), np.nan)
    estimate[number] = estimated_gusts(slabs, span)
    first_scan = slabs["time"].values - period / 2
    return SensorSamples(
        period,
        speed,
        span,
        float(np.median(slabs["x"].values - speed * first_scan)),
        float(np.median(slabs["delivered"].values - first_scan)),
        truth[MARGIN:-MARGIN],
        estimate,
        truth[:MARGIN],
        truth[-MARGIN:],
        -aircraft.roll_damping,
        lift,
    )


def estimated_gusts(slabs: xr.Dataset, span: float) -> np.ndarray:
    """Gusts of the recorded vectors of all slabs, on a level wing on the path; (slabs, 4).

    NaN in slabs where a vector that the wing needs is invalid, and of components that the lidar
    does not have.
    """
    y, _ = span_nodes(span)
    on_wing = slabs[[name for name in "uvw" if name in slabs]].interp(y=y, z=0.0)
    nothing = np.full((slabs.sizes["slab"], len(y)), np.nan)
    wind = [
        on_wing[name].transpose("slab", "y").values if name in on_wing else nothing
        for name in "uvw"
    ]
    return gusts(span, np.stack(wind))


def true_gusts(experiment: Experiment, x: np.ndarray, span: float) -> np.ndarray:
    """Gusts in planes x (m) when the wing arrives there on the nominal path; (planes, 4)."""
    y, _ = span_nodes(span)
    arrival = x / encounter_of(experiment).path.speed
    air = air_along_path(experiment)
    return gusts(span, np.stack(air.wind(x[:, None], y, 0.0, arrival[:, None])))


def pooled(all_of_them: list[SensorSamples]) -> Iterator[list[SensorSamples]]:
    """Flights with one sensor, nearest range first: of one timing, range and span."""
    groups: dict[tuple[float, ...], list[SensorSamples]] = {}
    for one in all_of_them:
        key = (one.distance, one.period, one.speed, one.delay, one.span)
        groups.setdefault(tuple(round(value, 6) for value in key), []).append(one)
    yield from (groups[key] for key in sorted(groups))
