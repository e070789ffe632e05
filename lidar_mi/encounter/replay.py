"""A flight's estimates again, for other aircraft and controllers: nothing is rendered.

Estimates are those of the recorded flight, with their noise. Poses of the new flight do not change
them: where another controller flies elsewhere, the lidar would have seen other nodes of the slab.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.encounter.flight import FEEDFORWARD, FlightData
from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.encounter.lidar.vector_record import wind_of
from lidar_mi.encounter.series import ESTIMATED, MEASURED
from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import value_at
from lidar_mi.experiment.export_flight import FLIGHT_FILES
from lidar_mi.experiment.folder.records import read_record
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.io.netcdf import read_netcdf
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import in_si, settings

NOT_RECORDED = "the recorded flight has no estimate of this scan"

# Keys that a replay may change: what flies and what steers.
_FREE = ("name", "encounter.aircraft", "encounter.control")


@dataclass(frozen=True, eq=False)
class RecordedLidar:
    """Delivers the estimates of a recorded flight; a `lidar_mi.encounter.ahead.preview.Lidar`.

    track (slab, ...): of the recorded flight.
    period: from scan to scan, s.
    stride: from slab to slab, m.
    latency: of the new flight, s; None: times of delivery as recorded.
    """

    track: xr.Dataset
    period: float
    stride: float
    latency: float | None

    def step(
        self, t: float, pose: AircraftPose | None = None, expected: VortexPairFit | None = None
    ) -> Estimate:
        """The estimate that was delivered of the scan at a time (s), from whatever pose."""
        valid = t - self.period / 2
        delivered = t + (self.latency or 0.0)
        away = np.abs(self.track["time"].values - valid)
        number = int(away.argmin())
        if away[number] > self.period / 4:
            scans = (valid - float(self.track["time"][0])) / self.period
            x = float(self.track["x"][0]) + scans * self.stride
            return Estimate(valid, delivered, x, None, None, (NOT_RECORDED,), {})
        one = self.track.isel(slab=number)
        wind_delivered = None
        if self.latency is None:
            delivered = float(one["delivered"])
            if "wind_delivered" in one and np.isfinite(one["wind_delivered"]):
                wind_delivered = float(one["wind_delivered"])
        flags = tuple(text for text in str(one["flags"].values).split("; ") if text)
        return Estimate(
            valid,
            delivered,
            float(one["x"]),
            wind_of(self.track, number),
            _pair(one),
            flags,
            {"all": float(one["seconds"])},
            None,
            wind_delivered,
        )


def _pair(one: xr.Dataset) -> VortexPairFit | None:
    if not float(one["estimated"]):
        return None
    reasons = str(one["estimate_reasons"].values)
    return VortexPairFit(
        one["estimate_parameters"].values,
        one["estimate_covariance"].values,
        one.attrs["profile"],
        *(np.nan,) * 4,
        reasons=tuple(reasons.split("; ")) if reasons else (),
        shared=one["estimate_shared"].values,
        shared_length=float(one["estimate_shared_length"]),
    )


def recorded_flight(folder: str | Path, experiment: Experiment) -> FlightData:
    """The data sets of a flight whose estimates an experiment may fly by.

    folder: of the recorded flight.
    experiment: differs from the recorded one in `encounter.aircraft` and `encounter.control` alone.

    Raises InputError: no flight with a lidar, or one from a version that did not record its
    estimates; another experiment; a mode of control without the lidar.
    """
    folder = Path(folder)
    if encounter_of(experiment).control.mode != FEEDFORWARD:
        raise InputError(
            f"encounter.control.mode: {encounter_of(experiment).control.mode} is not allowed with "
            f"a replay, as it needs no estimates; expected {FEEDFORWARD}"
        )
    recorded = in_si(read_record(folder)["experiment"])
    key = _difference(recorded, in_si(settings(experiment)))
    if key:
        was, now = (value_at(one, key) for one in (recorded, in_si(settings(experiment))))
        raise InputError(
            f"{key}: {now} is not the {was} of the flight in {folder}; a replay may change "
            "encounter.aircraft and encounter.control alone"
        )
    series, track, slabs = (folder / FLIGHT_FILES[name] for name in ("series", "track", "slabs"))
    if not (series.is_file() and track.is_file()):
        raise InputError(
            f"{folder}: holds no finished flight with the lidar; expected the folder of lidar-mi "
            "fly --mode feedforward"
        )
    dataset = read_netcdf(track)
    if not {*ESTIMATED} <= {*dataset.data_vars}:
        raise InputError(
            f"{track}: has no covariances of the estimates, as it is of an earlier version; "
            "expected a flight of this version"
        )
    return FlightData(read_netcdf(series), dataset, read_netcdf(slabs) if slabs.is_file() else None)


def recorded_lidar(recorded: FlightData, experiment: Experiment) -> RecordedLidar:
    """The lidar of a replay."""
    encounter = encounter_of(experiment)
    assert recorded.track is not None  # `recorded_flight` refuses its absence
    period = 1 / encounter.rate
    stride = period * encounter.path.speed
    return RecordedLidar(recorded.track, period, stride, encounter.control.latency)


def with_recorded(data: FlightData, recorded: FlightData) -> FlightData:
    """A replayed flight with images and errors of winds of the recorded one."""
    assert data.track is not None and recorded.track is not None  # both have a lidar
    track, number = data.track, min(data.track.sizes["slab"], recorded.track.sizes["slab"])
    measured = {}
    for name in MEASURED:
        values = np.zeros(track.sizes["slab"]) if name == "vectors" else track[name].values.copy()
        values[:number] = recorded.track[name].values[:number]
        measured[name] = ("slab", values, track[name].attrs)
    return replace(data, track=track.assign(measured), slabs=recorded.slabs)


def _difference(
    one: Mapping[str, Any], other: Mapping[str, Any], above: tuple[str, ...] = ()
) -> str | None:
    """The first key in which two experiments differ, of those that a replay may not change."""
    for name in dict.fromkeys((*one, *other)):
        key = ".".join((*above, name))
        if key in _FREE or one.get(name) == other.get(name):
            continue
        first, second = one.get(name), other.get(name)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            difference = _difference(first, second, (*above, name))
            if difference:
                return difference
            continue
        return key
    return None
