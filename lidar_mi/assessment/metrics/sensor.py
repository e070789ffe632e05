"""Verdict on both lidars as one sensor: vectors, lines of sight, cost of the lidars."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics
from lidar_mi.assessment.metrics.requirements import Finding, RequirementTable
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores

COMPONENTS = ("u", "v", "w")


@dataclass(frozen=True)
class LidarCost:
    """Cost of a lidar's scan, and distances from which eyes are safe.

    average_power: W.
    beams: directions that must be measured simultaneously, because of the time of flight.
    permissible_exposure: J m^-2, of each pulse; None: its pulses have no duration, hence no limit.
    hazard_distance, aided_hazard_distance: m, unaided and with binoculars; None: none, or infinite.
    """

    pulses_per_second: float
    average_power: float
    beams: int
    photons_per_direction: float | None = None
    permissible_exposure: float | None = None
    hazard_distance: float | None = None
    aided_hazard_distance: float | None = None


def vector_metrics(wind: xr.Dataset | None, cores: Sequence[Core]) -> dict[str, float]:
    """Errors of valid vectors (flag 0) of both lidars, as of `errors.error_statistics`.

    ``sensor.rmse_*``, ``bias_*`` (m/s), ``normalised_error_variance_*``, ``coverage_68_*``,
    ``coverage_95_*``; ``outside_cores.rmse_*`` beyond two core radii, and ``outside_cores.rms_*``
    of the true wind there; ``spanned_fraction`` of all vectors, between lines of sight.

    wind: from `combined.combine.combine`, with u_true, v_true, w_true; None: there is no wind.
    """
    if wind is None:
        return {"sensor.valid_fraction": 0.0, "sensor.vectors": 0}
    # with torch, which `check` does without
    from lidar_mi.flags import CombinedFlag

    valid = wind["flag"].values == 0
    z, y = np.meshgrid(wind["z"], wind["y"], indexing="ij")
    far = valid & outside_cores(y, z, list(cores))
    beyond_lines = (wind["flag"].values & CombinedFlag.BEYOND_LINES) != 0
    metrics = {
        "sensor.valid_fraction": float(valid.mean()),
        "sensor.vectors": int(valid.sum()),
        "sensor.spanned_fraction": float(1 - beyond_lines.mean()),
    }
    for name in COMPONENTS:
        true = wind[f"{name}_true"].values
        error = wind[name].values - true
        statistics = error_statistics(error, wind[f"{name}_stderr"].values, valid)
        for key in ("rmse", "bias", "normalised_error_variance", "coverage_68", "coverage_95"):
            if key in statistics:
                metrics[f"sensor.{key}_{name}"] = statistics[key]
        beyond = far & np.isfinite(error)
        if beyond.any():
            rmse = error_statistics(error, where=beyond)["rmse"]
            metrics[f"sensor.outside_cores.rmse_{name}"] = rmse
            # the rms error of zero wind
            strength = float(np.sqrt((true[beyond] ** 2).mean()))
            metrics[f"sensor.outside_cores.rms_{name}"] = strength
            metrics[f"sensor.outside_cores.std_{name}"] = float(true[beyond].std())
    return metrics


def without_skill(metrics: Mapping[str, float]) -> list[str]:
    """Components whose rms error equals the spread of the true wind: without skill.

    Beyond two core radii. Equal: not smaller by more than the standard error of an rms of n values,
    1 / sqrt(2 n) of it (Gaussian).
    """
    number = metrics.get("sensor.vectors", 0)
    components = []
    for name in COMPONENTS:
        keys = [f"sensor.outside_cores.{key}_{name}" for key in ("rmse", "std")]
        if number and all(key in metrics for key in keys):
            error, spread = (metrics[key] for key in keys)
            if error >= spread * (1 - 1 / math.sqrt(2 * number)):
                components.append(name)
    return components


def line_metrics(lines: xr.Dataset) -> dict[str, float]:
    """Number of lines of sight with a velocity, and their errors; m/s.

    lines (line): ``v_los``, ``v_los_true``, ``v_los_std`` (m s^-1); NaN without a velocity.
    """
    error = (lines["v_los"] - lines["v_los_true"]).values
    metrics: dict[str, float] = {
        "sensor.lines": len(error),
        "sensor.lines_retrieved": int(np.isfinite(error).sum()),
    }
    statistics = error_statistics(error, lines["v_los_std"].values)
    for key in ("rmse", "bias", "normalised_error_variance"):
        if key in statistics:
            metrics[f"sensor.{key}_v_los"] = statistics[key]
    return metrics


def doppler_alone_metrics(winds: Mapping[str, xr.Dataset], truth: xr.Dataset) -> dict[str, float]:
    """Errors of the Doppler lidar's vectors alone, ``sensor.triples.rmse_u`` and so on, m/s.

    winds: by combination of lines of sight: u, v, w, flag at z, y.
    truth: u, v, w on (z, y).
    """
    metrics = {}
    for key, wind in winds.items():
        valid = wind["flag"].values == 0
        for name in COMPONENTS:
            true = truth[name].interp(z=wind["z"], y=wind["y"])
            errors = error_statistics((wind[name] - true).values, where=valid)
            if errors:
                metrics[f"sensor.{key}.rmse_{name}"] = errors["rmse"]
    return metrics


def limit_metrics(mean_squares: Mapping[str, float]) -> dict[str, float]:
    """Error budget of u, ``sensor.error_budget.CAUSE.rmse_u`` (m/s) and ``.fraction_u``.

    mean_squares: mean square error of u (m^2 s^-2): with all causes as "", without each of them,
        and "sampling", the remainder without all. Empty: not known.
    """
    if not mean_squares:
        return {}
    metrics = {}
    for cause, square in mean_squares.items():
        if cause:
            remaining = square / mean_squares[""]
            key = f"sensor.error_budget.{cause}"
            metrics[f"{key}.rmse_u"] = math.sqrt(square)
            # sampling is what remains, not what is removed
            metrics[f"{key}.fraction_u"] = remaining if cause == "sampling" else 1 - remaining
    return metrics


def cost_metrics(costs: Mapping[str, LidarCost]) -> dict[str, float]:
    """Cost of the lidars, ``sensor.LIDAR.pulses_per_second`` and so on."""
    return {
        f"sensor.{lidar}.{name}": value
        for lidar, cost in costs.items()
        for name, value in asdict(cost).items()
        if value is not None
    }


def margin_metrics(
    judged: Sequence[tuple[RequirementTable, Sequence[Finding]]], speed: float
) -> dict[str, float]:
    """Margins to the requirements of the phase that is flown at a speed (m/s).

    They are ``sensor.APPLICATION.PHASE.applies``, 1 or 0, of every table; of those that apply
    ``sensor.APPLICATION.PHASE.QUANTITY.margin``.
    """
    applying = {
        f"sensor.{table.application}.{table.phase}.applies": float(table.applies_at(speed))
        for table, _ in judged
    }
    return applying | {
        f"sensor.{table.application}.{table.phase}.{row.quantity}.margin": row.margin
        for table, findings in judged
        for row in findings
        if table.applies_at(speed) and not math.isnan(row.margin)
    }
