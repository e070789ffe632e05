"""Flights as data sets: the time series, and the track slab by slab."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.aircraft.state import AircraftState, Commands
from lidar_mi.aircraft.strips import Loads
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.ahead.preview import Slab
from lidar_mi.encounter.lidar.estimate import SKIPPED
from lidar_mi.encounter.lidar.vector_record import recorded_vectors
from lidar_mi.experiment.truth.wake_along_path import vortices_in_plane
from lidar_mi.retrieval.vortices.model import PARAMETERS
from lidar_mi.retrieval.vortices.pair import MEANING, VortexPairFit
from lidar_mi.variables import variable

QUANTITIES = tuple(
    f"{side}_{name}"
    for side in ("port", "starboard")
    for name in ("circulation", "core_radius", "y", "z")
)
"""Of the track's data set, as of `VortexPairFit.quantities`."""

SOURCES = ("estimate", "track", "truth")

ESTIMATED = (
    "estimated",
    "estimate_parameters",
    "estimate_covariance",
    "estimate_shared",
    "estimate_shared_length",
    "estimate_reasons",
)
"""Of the track's data set: the fits as they were delivered, from which a flight is replayed."""

MEASURED = ("error_v_los", "error_u", "error_v", "error_w", "vectors")
"""Of the track's data set: what is known of the wind of each slab."""

_STATES: dict[str, tuple[str, str]] = {
    "x": ("m", "place along the path"),
    "y": ("m", "place to the left of the path"),
    "z": ("m", "place above the path"),
    "roll": ("rad", "bank angle, port wing up"),
    "pitch": ("rad", "pitch angle, nose up"),
    "yaw": ("rad", "yaw angle, nose to port"),
    "roll_rate": ("rad s-1", "roll rate"),
    "pitch_rate": ("rad s-1", "pitch rate"),
    "yaw_rate": ("rad s-1", "yaw rate"),
    "airspeed": ("m s-1", "true airspeed"),
    "departed": ("1", "1 from the moment at which the aircraft is upset"),
    "vertical_speed": ("m s-1", "vertical speed across the path"),
    "load_factor": ("1", "vertical load factor"),
    "port_bending": ("N m", "bending moment of the port wing root, change from trim, tip up"),
    "starboard_bending": ("N m", "bending moment of the starboard wing root, likewise"),
}
_LOADS = {
    "force_x": ("N", "force of the wind forward"),
    "force_y": ("N", "force of the wind to the left"),
    "force_z": ("N", "force of the wind upwards"),
    "roll_moment": ("N m", "rolling moment of the wind, port wing up"),
    "pitch_moment": ("N m", "pitching moment of the wind, nose down"),
    "yaw_moment": ("N m", "yawing moment of the wind, nose to port"),
}
_CONTROLS = ("aileron", "elevator", "rudder", "symmetric_aileron")
_COMMANDS = {name: ("rad", f"{name.replace('_', ' ')} asked for") for name in _CONTROLS}
_DEFLECTIONS = {
    f"{name}_deflection": ("rad", f"{name.replace('_', ' ')} as deflected")
    for name in ("aileron", "elevator", "symmetric_aileron")
}
_CONTROL = ("N m", "rolling moment of the controls")


class FlightRecorder:
    """Records a flight, instant by instant."""

    def __init__(self) -> None:
        self._rows: list[dict[str, float]] = []

    def add(
        self,
        state: AircraftState,
        loads: Loads,
        predicted: Loads | None,
        commands: Commands,
        deflection: np.ndarray,
        control_moments: np.ndarray,
        symmetric: float = 0.0,
    ) -> None:
        """Record one instant: deflections in rad, moments per deflection in N m per rad."""
        row = {field.name: float(getattr(state, field.name)) for field in fields(state)}
        row |= _named(loads, "")
        # every instant has all columns
        nothing = Loads(np.full(3, np.nan), np.full(3, np.nan))
        row |= _named(predicted or nothing, "predicted_")
        row |= {name: float(getattr(commands, name)) for name in _COMMANDS}
        deflections = (deflection[0], deflection[1], symmetric)
        row |= {name: float(v) for name, v in zip(_DEFLECTIONS, deflections, strict=True)}
        row["control_roll_moment"] = float(control_moments[0] @ deflection)
        self._rows.append(row)

    def dataset(self) -> xr.Dataset:
        """All instants, dims (time,)."""
        meaning = {
            **_STATES,
            **_LOADS,
            **{f"predicted_{name}": (u, f"predicted {text}") for name, (u, text) in _LOADS.items()},
            **_COMMANDS,
            **_DEFLECTIONS,
            "control_roll_moment": _CONTROL,
        }
        time = np.array([row["time"] for row in self._rows])
        return xr.Dataset(
            {
                name: variable("time", np.array([row[name] for row in self._rows]), *about)
                for name, about in meaning.items()
            },
            coords={"time": variable("time", time, "s", "time of flight")},
        )


def _named(loads: Loads, prefix: str) -> dict[str, float]:
    values = [*loads.force, *loads.moment]
    return {f"{prefix}{name}": float(v) for name, v in zip(_LOADS, values, strict=True)}


def flights_dataset(flights: dict[str, xr.Dataset]) -> xr.Dataset:
    """Flights of the same duration as one data set, dims (flight, time)."""
    # times of the flights of an encounter are equal to the last bit: a difference is a fault
    names = xr.DataArray(list(flights), dims="flight", attrs={"long_name": "what steers"})
    return xr.concat(list(flights.values()), names.rename("flight"), join="exact")


def track_dataset(slabs: Sequence[Slab], wake: WakeAlongPath) -> xr.Dataset:
    """Estimates, track and truth in the plane and at the time of every slab.

    Returns
    -------
    xr.Dataset, dims (slab) and (source, slab)
        The quantities `QUANTITIES`, with their standard errors, for `SOURCES`; NaN where there is
        none. `ESTIMATED` has the fits as they were delivered; the vectors are those of
        `recorded_vectors`.
    """
    rows = [_row(slab, wake) for slab in slabs]
    dataset = xr.Dataset(
        coords={
            "slab": ("slab", np.arange(len(rows)), {"long_name": "slab delivered"}),
            "source": ("source", list(SOURCES)),
        }
    )
    for name, about in _PER_SLAB.items():
        dataset[name] = variable("slab", [row[name] for row in rows], *about)
    dataset["flags"] = (
        "slab",
        np.array(["; ".join(s.estimate.flags) for s in slabs], dtype=object),
    )
    for name in QUANTITIES:
        units, text = MEANING[name]
        for suffix in ("", "_stderr"):
            values = np.array([[row[source, name + suffix] for row in rows] for source in SOURCES])
            words = f"standard error of {text}" if suffix else text
            values = values.reshape(len(SOURCES), -1)
            dataset[name + suffix] = variable(("source", "slab"), values, units, words)
    fits = _fits([slab.estimate.pair for slab in slabs])
    vectors = recorded_vectors([slab.estimate for slab in slabs])
    return dataset.merge(fits).merge(vectors).assign_attrs(fits.attrs | vectors.attrs)


def _fits(pairs: Sequence[VortexPairFit | None]) -> xr.Dataset:
    """The variables `ESTIMATED`; NaN where there is no fit."""
    count = len(PARAMETERS)
    there = [pair is not None for pair in pairs]
    parameters = np.full((len(pairs), count), np.nan)
    covariance = np.full((len(pairs), count, count), np.nan)
    shared, lengths = np.zeros_like(covariance), np.zeros(len(pairs))
    for number, pair in enumerate(pairs):
        if pair is not None:
            parameters[number], covariance[number] = pair.parameters, pair.covariance
            lengths[number] = pair.shared_length
            if pair.shared is not None:
                shared[number] = pair.shared
    reasons = ["; ".join(pair.reasons) if pair is not None else "" for pair in pairs]
    about = {"long_name": "m2 s-1, log of m, m, m of port and starboard; mean v and w in m s-1"}
    fits = xr.Dataset(
        {
            "estimated": variable("slab", np.array(there, float), "1", "1: a fit"),
            "estimate_parameters": (("slab", "parameter"), parameters, about),
            "estimate_covariance": (("slab", "parameter", "parameter_2"), covariance, about),
            "estimate_shared": (("slab", "parameter", "parameter_2"), shared, about),
            "estimate_shared_length": variable(
                "slab", lengths, "m", "over which errors by the ambient wind are shared"
            ),
            "estimate_reasons": ("slab", np.array(reasons, dtype=object)),
        },
        {"parameter": list(PARAMETERS), "parameter_2": list(PARAMETERS)},
    )
    profiles = [pair.profile for pair in pairs if pair is not None]
    # one flight has one profile
    return fits.assign_attrs({"profile": profiles[0]} if profiles else {})


_PER_SLAB = {
    "time": ("s", "time at which the estimate is valid"),
    "delivered": ("s", "time at which the vortices are there"),
    "wind_delivered": ("s", "time at which the wind is there"),
    "x": ("m", "plane of the slab along the path"),
    "accepted": ("1", "1: the fit of this slab is valid"),
    "usable": ("1", "1: the track can be steered by"),
    "updates": ("1", "slabs that the track took in"),
    "rejected": ("1", "slabs that the track refused"),
    "innovation": ("1", "normalised square of the innovation"),
    "innovation_dof": ("1", "its degrees of freedom"),
    "skipped": ("1", "1: the computer was busy, and its vortices were skipped"),
    "wind_skipped": ("1", "1: the same of its wind"),
    "error_v_los": ("m s-1", "rms error of the speeds along lines of sight"),
    "error_u": ("m s-1", "rms error of u over the valid vectors"),
    "error_v": ("m s-1", "rms error of v over the valid vectors"),
    "error_w": ("m s-1", "rms error of w over the valid vectors"),
    "vectors": ("1", "number of valid vectors"),
    "seconds": ("s", "processor time of the estimate"),
}


def _row(slab: Slab, wake: WakeAlongPath) -> dict[Any, float]:
    estimate, track = slab.estimate, slab.track
    pair = estimate.pair
    innovation = (track.innovation if track else None) or (np.nan, np.nan)
    row: dict[Any, float] = {
        "time": estimate.time,
        "delivered": estimate.delivered,
        "wind_delivered": np.nan if estimate.wind_delivered is None else estimate.wind_delivered,
        "x": estimate.x,
        "accepted": float(pair is not None and pair.success),
        "usable": float(track is not None and track.usable),
        "updates": float(track.updates if track else 0),
        "rejected": float(track.rejected if track else 0),
        "innovation": float(innovation[0]),
        "innovation_dof": float(innovation[1]),
        "seconds": float(sum(estimate.seconds.values())),
        "skipped": float(f"vortices: {SKIPPED}" in estimate.flags),
        "wind_skipped": float(f"wind: {SKIPPED}" in estimate.flags),
        "error_v_los": _line_error(estimate.lines),
        **_wind_errors(estimate.wind, wake, estimate.x, estimate.time),
    }
    tracked = track.pair_at(estimate.x, estimate.time) if track else None
    for source, pair_or_track in (("estimate", pair), ("track", tracked)):
        row |= {(source, name): value for name, value in _numbers(pair_or_track).items()}
    true = vortices_in_plane(wake, estimate.x, estimate.time)
    truth = dict(zip(("port", "starboard"), true, strict=True)) if true else {}
    for name in QUANTITIES:
        side, quantity = name.split("_", 1)
        row["truth", name] = getattr(truth[side], quantity) if truth else np.nan
        row["truth", f"{name}_stderr"] = 0.0
    return row


def _numbers(pair: VortexPairFit | None) -> dict[str, float]:
    """Quantities of a valid pair with their standard errors; else NaN."""
    if pair is None or not pair.success:
        return {name + suffix: np.nan for name in QUANTITIES for suffix in ("", "_stderr")}
    stderr, numbers = np.sqrt(np.diagonal(pair.covariance)), {}
    for name in QUANTITIES:
        logarithm = name.endswith("core_radius")
        k = PARAMETERS.index(name.replace("core_radius", "log_radius"))
        value = float(np.exp(pair.parameters[k]) if logarithm else pair.parameters[k])
        numbers[name] = value
        # to first order the standard error of exp(q) is exp(q) times that of q
        numbers[f"{name}_stderr"] = float(stderr[k]) * (value if logarithm else 1.0)
    return numbers


def _line_error(lines: xr.Dataset | None) -> float:
    """Rms error of the lines that could be read; NaN: none."""
    if lines is None:
        return np.nan
    return float(np.sqrt(((lines["v_los"] - lines["v_los_true"]) ** 2).mean()))


def _wind_errors(
    wind: xr.Dataset | None, wake: WakeAlongPath, x: float, time: float
) -> dict[str, float]:
    """Rms errors of the vectors that are valid; NaN where a component was not estimated."""
    row = {"error_u": np.nan, "error_v": np.nan, "error_w": np.nan, "vectors": 0.0}
    if wind is None:
        return row
    y, z = np.meshgrid(wind["y"].values, wind["z"].values)
    truth = wake.wind(np.full(y.shape, x), y, z, time)
    valid = (wind["flag"].transpose("z", "y") == 0).values
    row["vectors"] = float(valid.sum())
    for name, true in zip("uvw", truth, strict=True):
        if name in wind and valid.any():
            error = (wind[name].transpose("z", "y").values - true)[valid]
            row[f"error_{name}"] = float(np.sqrt(np.mean(error**2)))
    return row
