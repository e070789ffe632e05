"""From the results of a run to its metrics."""

import math
from collections.abc import Mapping

import xarray as xr

from lidar_mi.assessment.metrics.coherent import lines_metrics, profile_metrics, vortex_scan_metrics
from lidar_mi.assessment.metrics.images import light_metrics, noise_metrics
from lidar_mi.assessment.metrics.names import (
    Source,
    budget_key,
    far_from_cores,
    timing_key,
    wind_key,
)
from lidar_mi.assessment.metrics.pointing import pointing_metrics
from lidar_mi.assessment.metrics.requirements import Finding, RequirementTable, judge
from lidar_mi.assessment.metrics.rings import ring_budget_metrics
from lidar_mi.assessment.metrics.safety import safety_metrics
from lidar_mi.assessment.metrics.sensor import (
    COMPONENTS,
    cost_metrics,
    doppler_alone_metrics,
    limit_metrics,
    line_metrics,
    margin_metrics,
    vector_metrics,
    without_skill,
)
from lidar_mi.assessment.metrics.simulation import sample_metrics, simulation_metrics
from lidar_mi.assessment.metrics.velocities import velocity_metrics
from lidar_mi.assessment.metrics.volume import volume_metrics
from lidar_mi.assessment.metrics.vortices import core_metrics, vortex_metrics
from lidar_mi.assessment.metrics.winds import cross_flow_metrics, sweep_metrics, true_wind_metrics
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.pipeline import Results
from lidar_mi.experiment.stages.light_budget import backscatter_fractions
from lidar_mi.schema.experiment import Experiment

_NO_SKILL = "{} has no skill: its error equals the spread of the wind"


def measure(
    experiment: Experiment, results: Results, seconds: Mapping[str, float]
) -> dict[str, float]:
    """All metrics of a run, flat, from the results and the duration (s) of its stages by name."""
    metrics: dict[str, float] = {}
    if experiment.imaged_wake and "images" in results:
        inputs = {"truth": results["truth"], "air": results["air"]}
        fractions = call(
            backscatter_fractions, experiment, **inputs, clear_air=results["clear_air"]
        )
        metrics |= {
            f"backscatter.fraction.{name}": value for name, value in fractions._asdict().items()
        }
    if "wind" in results:
        metrics |= _images(results)
    if "wind_volume" in results:
        metrics |= volume_metrics(results["wind_volume"], results["cores"])
        metrics |= noise_metrics(results["scans"][0]) | sample_metrics(results["detected"])
    if "pointing" in results:
        metrics |= pointing_metrics(results["pointing"])
    if "error_budget" in results:
        for method, budget in results["error_budget"].items():
            metrics |= {budget_key(method, key): value for key, value in budget.items()}
    if experiment.fringes is not None and "v_los" in results:
        averaged = experiment.fringes.retrieval.averaged
        metrics |= ring_budget_metrics(results["ring_budget"], averaged)
        metrics |= velocity_metrics(results["v_los"])
    if "coherent_lines" in results:
        metrics |= lines_metrics(results["coherent_lines"])
    if "line_winds" in results:
        metrics |= profile_metrics(results["line_winds"])
    if "line_vortices" in results:
        metrics |= vortex_scan_metrics(results["line_vortices"])
    if "lines" in results:
        metrics |= _sensor(results)
    if "vortices" in results:
        truth, pairs = results["truth"].wind, results["vortices"].pairs
        metrics |= vortex_metrics(pairs, truth, results["cores"])
    metrics |= margin_metrics(judged(experiment, results, metrics), experiment.platform.speed)
    return metrics | {timing_key(step): round(value, 3) for step, value in seconds.items()}


def _images(results: Results) -> dict[str, float]:
    winds, cores = results["wind"], results["cores"]
    place = {axis: slice(winds[axis].min(), winds[axis].max()) for axis in ("y", "z")}
    noise, changes = results.get("detector_noise", {}), results.get("simulation_noise")
    true = results["truth"].wind.sel(place)
    if 0 in true.sizes.values():
        # a single row or column of vectors, between nodes
        true = results["truth"].wind.sel(y=winds["y"], z=winds["z"], method="nearest")
    return (
        cross_flow_metrics(winds, cores)
        | ({} if changes is None else simulation_metrics(changes, winds, cores))
        | light_metrics(results["scans"][0])
        | sample_metrics(results["detected"])
        | core_metrics(cores)
        | true_wind_metrics(true, cores)
        | (sweep_metrics(results["texture_sweep"]) if "texture_sweep" in results else {})
        | {f"detector.{key}": value for key, value in noise.items()}
        | safety_metrics(results["eye_safety"])
    )


def _sensor(results: Results) -> dict[str, float]:
    pulses = results["pulses_needed"]
    return (
        line_metrics(results["lines"])
        | vector_metrics(results["wind3d"], results["cores"])
        | limit_metrics(results["u_limits"])
        | doppler_alone_metrics(results["doppler_alone"], results["slab_wind"])
        | cost_metrics(results["costs"])
        | ({} if pulses is None else {"sensor.doppler.pulses_needed": pulses})
    )


def judged(
    experiment: Experiment, results: Results, metrics: Mapping[str, float]
) -> list[tuple[RequirementTable, list[Finding]]]:
    """The lidars compared with every requirement table; empty where there are none.

    Errors are those beyond two core radii. Rows of what the lidars do not measure, and errors of a
    component without skill, are not judged; nor are images by tables of velocities along lines of
    sight.
    """
    verdicts = []
    for table in results.get("requirements", {}).values():
        along = any(row.quantity == "error_v_los" for row in table.rows)
        if experiment.sensor is not None:
            measured = _of_both_lidars(experiment, metrics, along)
            reasons = {f"error_{name}": _NO_SKILL.format(name) for name in without_skill(metrics)}
            if "u" not in results["truth"].wind:
                reasons["error_u"] = "the flow has no u"
        elif along:
            continue
        else:
            measured, reasons = _of_images(experiment, results["wind"], metrics)
        measured["range"] = _nearest_range(experiment, table)
        verdicts.append((table, judge(table, measured, reasons)))
    return verdicts


def _nearest_range(experiment: Experiment, table: RequirementTable) -> float:
    """Of the ranges that the table allows, the one nearest to the slab's middle, if in the slab."""
    near, far = experiment.scan.range, experiment.scan.range + experiment.scan.thickness
    middle = (near + far) / 2
    rows = (row for row in table.rows if row.quantity == "range")
    allowed = next((min(max(middle, row.minimum), row.maximum) for row in rows), middle)
    return allowed if near <= allowed <= far else middle


def _of_both_lidars(
    experiment: Experiment, metrics: Mapping[str, float], along: bool
) -> dict[str, float | None]:
    """Properties of both lidars, SI, by rows of a table.

    Points are lines of sight where velocities ``along`` them are required, else valid vectors whose
    windows do not overlap.
    """
    doppler, sensor = experiment.fringes, experiment.sensor
    assert doppler is not None and sensor is not None
    depth = doppler.lidar.range_bin
    vectors = math.floor(_independent_fraction(experiment) * metrics["sensor.vectors"])
    return {
        "points_per_slab": metrics["sensor.lines_retrieved"] if along else vectors,
        "slabs_per_second": sensor.slabs_per_second,
        "slab_depth": depth if along else max(depth, experiment.scan.thickness),
        "error_v_los": metrics.get("sensor.rmse_v_los"),
        **{f"error_{n}": metrics.get(f"sensor.outside_cores.rmse_{n}") for n in COMPONENTS},
    }


def _of_images(
    experiment: Experiment, wind: xr.Dataset, metrics: Mapping[str, float]
) -> tuple[dict[str, float | None], dict[str, str]]:
    """Properties of the backscatter lidar alone, SI, and why rows are not judged.

    They are those of the first method with a valid vector. Every image completes a pair with the
    one before it.
    """
    source = Source.NOISY if experiment.detector else Source.BACKSCATTER
    methods, scan = experiment.retrieval.methods, experiment.scan
    valid = {m: metrics.get(wind_key(source, m, "valid_fraction"), 0.0) for m in methods}
    method = next((m for m in methods if valid[m]), methods[0])
    vectors = valid[method] * wind.sizes["z"] * wind.sizes["y"]
    measured: dict[str, float | None] = {
        "slab_depth": scan.thickness,
        "slabs_per_second": 1 / experiment.platform.dt,
        "points_per_slab": math.floor(_independent_fraction(experiment) * vectors),
    }
    reasons = {"error_u": "needs a Doppler lidar"}
    far = far_from_cores(metrics, "true_wind.", "rms_")
    for name in ("v", "w"):
        error = metrics.get(wind_key(source, method, f"{far}rmse_{name}"))
        measured[f"error_{name}"] = error
        if error is not None and error >= metrics[f"true_wind.{far}rms_{name}"]:
            reasons[f"error_{name}"] = _NO_SKILL.format(name)
    return measured, reasons


def _independent_fraction(experiment: Experiment) -> float:
    """Fraction of the vectors whose windows do not overlap."""
    return min(1.0, experiment.retrieval.stride / experiment.retrieval.template) ** 2
