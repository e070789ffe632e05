"""Numbers of a flight through a wake: its motion, the lidar's estimates, and their times.

Every function takes data sets of a flight: ``series``, dims (flight, time), with the flights off,
feedforward and perfect; ``track``, dims (source, slab), with the sources estimate, track and truth.
Angles in rad, times in s.
"""

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.constants import g

from lidar_mi.assessment.metrics.encounter_hazard import is_hazardous, roll_control_ratio
from lidar_mi.assessment.metrics.load_increments import load_increments
from lidar_mi.assessment.metrics.requirements import Finding, RequirementTable, judge
from lidar_mi.assessment.metrics.wind_ahead import wind_ahead_metrics

CONTROLLER = "controller"
"""Attribute of the time series: the name of a user's controller."""

MET = "met"
"""Attribute of the time series: what a flight meets, "wake" (by default) or "air"."""

_NAMES = {
    "off": "without control",
    "autopilot": "autopilot",
    "feedforward": "with the lidar",
    "perfect": "perfect preview",
}
MODES = tuple(_NAMES)
"""Flights, as files name them, in the order in which they are shown."""

LEAST_REMOVED = {"largest_roll": math.radians(0.5), "largest_load_increment": 0.315 / g}
"""Least reduction by perfect preview, beyond the autopilot, of which a lidar can be judged.

0.5 degrees of bank is the project's own limit; an acceleration below 0.315 m/s^2 is not
uncomfortable (ISO 2631-1:1997, annex C)."""

AFTER = 5
"""Slabs after which the track is compared with the truth."""

# Rolling moments, as a fraction of the controls', and angles (rad) below this are rounding.
_ROUNDING = 1e-9

_FELT = 0.1
"""Fraction of the wake's largest rolling moment at which it counts as felt."""

_CIRCULATIONS = ("port_circulation", "starboard_circulation")
_PLACES = ("port_y", "port_z", "starboard_y", "starboard_z")
_SIGMAS = 2.0


def flight_name(mode: str, controller: str = "") -> str:
    """What a flight is called; without a preview, a controller of one's own by its own name."""
    if controller and mode == "autopilot":
        return f"{controller}, no preview"
    return _NAMES[mode]


def encounter_metrics(series: xr.Dataset, track: xr.Dataset | None) -> dict[str, float]:
    """All numbers of a flight, flat; without a lidar there is no track."""
    metrics: dict[str, float] = {}
    for mode in series["flight"].values:
        flight = series.sel(flight=mode)
        largest = float(flight["largest_control_roll_moment"])
        key, roll = f"encounter.{mode}", _largest(flight["roll"])
        metrics[f"{key}.largest_roll"] = roll
        metrics[f"{key}.largest_roll_rate"] = _largest(flight["roll_rate"])
        metrics[f"{key}.largest_lift"] = _largest(flight["force_z"])
        metrics[f"{key}.residual_moment"] = residual_moment(flight)
        metrics[f"{key}.roll_control_ratio"] = roll_control_ratio(
            flight["roll_moment"].values, largest
        )
        metrics |= {f"{key}.{name}": value for name, value in load_increments(flight).items()}
        metrics[f"{key}.departed"] = float(flight["departed"].max())
        metrics[f"{key}.hazardous"] = float(is_hazardous(roll) or flight["departed"].max() > 0)
    for quantity, least in LEAST_REMOVED.items():
        keys = [f"encounter.{mode}.{quantity}" for mode in ("autopilot", "feedforward", "perfect")]
        if all(key in metrics for key in keys):
            before, ours, best = (metrics[key] for key in keys)
            added = float(fraction_added(before, ours, best, least))
            metrics[f"encounter.removed_beyond_autopilot.{quantity}"] = added
    if track is not None:
        tracking = _tracking(series, track) | wind_ahead_metrics(track)
        metrics |= {f"encounter.{k}": v for k, v in tracking.items()}
    return {key: value for key, value in metrics.items() if np.isfinite(value)}


def fraction_added(
    autopilot: ArrayLike, lidar: ArrayLike, perfect: ArrayLike, least: float
) -> np.ndarray:
    """What the lidar removes beyond the autopilot over what perfect preview removes beyond it.

    autopilot, lidar, perfect: largest roll, say, of the flights.
    least: NaN where perfect preview removes less: there is nothing that a lidar could add.
    """
    before, ours, best = (np.asarray(peak, dtype=float) for peak in (autopilot, lidar, perfect))
    room = before - best
    return np.divide(before - ours, room, out=np.full(room.shape, np.nan), where=room >= least)


def residual_moment(flight: xr.Dataset) -> float:
    """Rms rolling moment of wake and controls together, over that of the wake alone.

    NaN where the wake's is rounding: across a wake at right angles both wings meet the same wind.
    """
    wake, control = flight["roll_moment"].values, flight["control_roll_moment"].values
    strength = float(np.sqrt(np.mean(wake**2)))
    if strength <= _ROUNDING * float(flight["largest_control_roll_moment"]):
        return float("nan")
    return float(np.sqrt(np.mean((wake + control) ** 2))) / strength


def prediction_error(flight: xr.Dataset) -> float:
    """Rms difference of predicted and true rolling moment, over the rms of the true one."""
    predicted = np.isfinite(flight["predicted_roll_moment"].values)
    true = flight["roll_moment"].values[predicted]
    error = flight["predicted_roll_moment"].values[predicted] - true
    strength = float(np.sqrt(np.mean(true**2))) if true.size else 0.0
    return float(np.sqrt(np.mean(error**2))) / strength if strength else float("nan")


def felt_from(series: xr.Dataset) -> float:
    """Time (s) at which the wake's rolling moment is first felt without control; NaN: never.

    In other air that of the wake alone, on the nominal path; NaN without a wake.
    """
    alone = "wake_roll_moment" in series
    if series.attrs.get(MET) == "air" and not alone:
        return float("nan")
    moment = series["wake_roll_moment"] if alone else series["roll_moment"].sel(flight="off")
    moment = np.abs(moment.values)
    felt = np.flatnonzero(moment > _FELT * moment.max())
    return float(series["time"][felt[0]]) if felt.size else float("nan")


def measured_in_flight(
    series: xr.Dataset, track: xr.Dataset, slab_depth: float
) -> dict[str, float]:
    """Rows of a requirement table, as measured in flight.

    The range is the distance flown from the delivery of an estimate to its slab; errors are those
    of valid vectors and of lines of sight against the truth; u and lines of sight are absent
    without a Doppler lidar.
    """
    measured = track.where(track["vectors"] > 0, drop=True)
    # as the flight begins: the wake changes it
    speed = float(series["airspeed"].isel(time=0).mean())
    look_ahead = _look_ahead(series, track)
    rows = {
        "range": float(np.median(look_ahead) * speed) if look_ahead.size else float("nan"),
        "slabs_per_second": _rate(track),
        "slab_depth": slab_depth,
        "points_per_slab": float(measured["vectors"].median()) if measured.sizes["slab"] else 0.0,
    }
    for name in ("v_los", "u", "v", "w"):
        errors = measured[f"error_{name}"].values if f"error_{name}" in measured else np.array([])
        errors = errors[np.isfinite(errors)]
        if errors.size:
            rows[f"error_{name}"] = float(np.sqrt(np.mean(errors**2)))
    return rows


def judged_in_flight(
    tables: Mapping[tuple[str, str], RequirementTable], measured: Mapping[str, float], speed: float
) -> list[tuple[RequirementTable, list[Finding]]]:
    """Requirements of flight control at an air speed (m/s) against what was measured."""
    return [
        (table, judge(table, measured))
        for (application, _), table in tables.items()
        if application == "flight_control" and table.applies_at(speed)
    ]


def _rate(track: xr.Dataset) -> float:
    """Estimates a second (Hz), less those that the computer skipped."""
    if track.sizes["slab"] < 2:
        return 0.0
    processed = 1 - float(track["skipped"].mean()) if "skipped" in track else 1.0
    # without the rounding of times
    return round(processed / float(np.median(np.diff(track["time"].values))), 9)


def _look_ahead(series: xr.Dataset, track: xr.Dataset) -> np.ndarray:
    """Time (s) from each estimate to the aircraft's arrival in its plane, where it arrives."""
    flight = series.sel(flight="feedforward")
    # a flight that ends before a slab never arrives there
    arrival = np.interp(
        track["x"].values, flight["x"].values, flight["time"].values, left=np.nan, right=np.nan
    )
    look_ahead = arrival - track["delivered"].values
    return look_ahead[np.isfinite(look_ahead)]


def _tracking(series: xr.Dataset, track: xr.Dataset) -> dict[str, float]:
    """Lead time, slabs to a track, errors after some slabs and over all of them, consistency."""
    metrics: dict[str, float] = {"slabs": float(track.sizes["slab"])}
    flight = series.sel(flight="feedforward")
    metrics["prediction_error"] = prediction_error(flight)
    look_ahead = _look_ahead(series, track)
    if look_ahead.size:
        metrics["look_ahead"] = float(np.median(look_ahead))
    steered = np.flatnonzero(np.isfinite(flight["predicted_roll_moment"].values))
    if steered.size:
        metrics["preview_from"] = float(flight["time"][steered[0]])
        metrics["lead_time"] = felt_from(series) - metrics["preview_from"]
    if "preview_withdrawn" in flight:
        step = float(flight["time"][1] - flight["time"][0])
        metrics["withdrawn"] = step * float(flight["preview_withdrawn"].sum())
    metrics |= _latencies(track)
    usable = np.flatnonzero(track["usable"].values > 0)
    metrics["usable_slabs"] = float(usable.size)
    accepted = track["accepted"].values > 0
    metrics["accepted_slabs"] = float(accepted.sum())
    metrics["rejected_slabs"] = float(track["rejected"].max()) if track.sizes["slab"] else 0.0
    if usable.size:
        first = int(usable[0])
        used = np.flatnonzero(accepted)
        metrics["slabs_to_track"] = float((used <= first).sum())
    after = np.flatnonzero((track["updates"].values >= AFTER) & (track["usable"].values > 0))
    if after.size:
        metrics |= {f"after_{AFTER}_slabs.{k}": v for k, v in _errors(track, after[:1]).items()}
        metrics |= {f"tracked.{k}": v for k, v in _errors(track, after).items()}
    dof = track["innovation_dof"].values
    tested = (dof > 0) & np.isfinite(track["innovation"].values) & accepted
    if tested.any():
        # 1 where innovations are as large as stated
        metrics["normalised_innovation"] = float(
            track["innovation"].values[tested].sum() / dof[tested].sum()
        )
    return metrics


def _latencies(track: xr.Dataset) -> dict[str, float]:
    """Times from the second scan to the delivery, and what a busy computer skipped."""
    scanned = track["time"].values + np.median(np.diff(track["time"].values)) / 2
    metrics = {}
    for name, delivered, skipped in (
        ("latency", "delivered", "skipped"),
        ("wind_latency", "wind_delivered", "wind_skipped"),
    ):
        if delivered not in track or skipped not in track:
            continue
        metrics[skipped + "_slabs"] = float(track[skipped].sum())
        valid = np.isfinite(track[delivered].values) & (track[skipped].values == 0)
        if name == "latency":
            valid &= track["estimated"].values > 0
        if valid.any():
            latency = track[delivered].values[valid] - scanned[valid]
            metrics[name], metrics[f"{name}_99"] = map(float, np.quantile(latency, [0.5, 0.99]))
    return metrics


def _errors(track: xr.Dataset, slabs: np.ndarray) -> dict[str, float]:
    """Largest errors of circulations (relative) and cores (m) of the track; fraction in 2 sigma."""
    part = track.isel(slab=slabs)
    ours, truth = part.sel(source="track"), part.sel(source="truth")
    relative = [np.abs(ours[q] / truth[q] - 1) for q in _CIRCULATIONS]
    cores = [
        np.hypot(ours[f"{side}_y"] - truth[f"{side}_y"], ours[f"{side}_z"] - truth[f"{side}_z"])
        for side in ("port", "starboard")
    ]
    within = [
        np.abs(ours[q] - truth[q]) <= _SIGMAS * ours[f"{q}_stderr"]
        for q in (*_CIRCULATIONS, *_PLACES)
    ]
    return {
        "circulation_error": float(np.max(relative)),
        "core_error": float(np.max(cores)),
        "within_2_sigma": float(np.mean(within)),
    }


def _largest(values: xr.DataArray) -> float:
    return float(np.abs(values).max())
