"""The combined sensor's chapter of a report: compliance, errors, resources."""

from collections.abc import Mapping, Sequence
from typing import Any

from lidar_mi.assessment.digits import in_row, percent, three
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.metrics.requirements import Judged, look_ahead
from lidar_mi.assessment.report.compliance import compliance
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables
from lidar_mi.instrument.doppler_scan import PlatformErrors
from lidar_mi.retrieval.combined.vectors import COMPONENTS
from lidar_mi.schema.experiment import Experiment


def sensor_chapter(
    experiment: Experiment,
    metrics: Mapping[str, float],
    judged: Judged,
    drawn: Sequence[Drawn],
    vectors: dict[str, Any] | None = None,
) -> Chapter:
    """Winds of both lidars together, and their compliance with requirements.

    Without requirements nothing is judged. Vectors are those of `vector_map.map_data`.
    """
    speed = experiment.platform.speed
    purpose = (
        "Both lidars observe the same slab of air: the Doppler lidar's lines of sight and the "
        "cross-flow wind of the backscatter lidar's images give the wind in three dimensions."
    )
    if speed:
        ahead = look_ahead(experiment.scan.range, speed)
        warning = f"At {speed:g} m/s the look-ahead time is {ahead:.2g} s."
    else:
        warning = "The platform is at rest: there is no look-ahead time"
        warning += "." if judged else ", and requirements for flight control do not apply."
    if vectors:
        vectors = {"title": "The wind from both lidars, vector by vector"} | vectors
    return Chapter(
        title="Both lidars as one sensor",
        lead=[
            purpose,
            warning,
            *_limit_of_u(metrics),
            *(_not_stated(experiment.sensor.errors) if experiment.sensor else []),
            *_costs(metrics),
        ],
        drawn=drawn,
        verdict=compliance(
            judged,
            speed,
            "Errors of u, v, w are rms errors of valid vectors beyond two core radii, those of "
            "v_LOS rms errors of lines of sight.",
        ),
        numbers=Tables(
            "Accuracy of the wind from both lidars",
            f"{metrics['sensor.lines_retrieved']} of {metrics['sensor.lines']} lines of sight were "
            f"retrieved; {metrics['sensor.vectors']} vectors, "
            f"{percent(metrics['sensor.valid_fraction'])}, are valid. Errors over standard errors "
            "have a variance of 1 where they are as stated; then 68 % lie within one standard "
            "error and 95 % within 1.96.",
            [_numbers(metrics)],
        ),
        vectors=vectors,
    )


# A cause with a smaller fraction of u's mean square error is not named.
_LEAST = 0.05
_CAUSES = {
    "sampling": "sampling error between the lines of sight",
    "line_noise": "noise of the rings",
    "range_bin": "averaging along the range bin",
    "crossflow": "errors of v and w",
    "pointing": "errors of attitude and pointing",
}


def _limit_of_u(metrics: Mapping[str, float]) -> list[str]:
    """The error budget of u, in a sentence; empty where it is not known."""
    keys = {c: f"sensor.error_budget.{c}.fraction_u" for c in _CAUSES}
    fractions = {c: metrics[key] for c, key in keys.items() if key in metrics}
    if not fractions:
        return []
    ranked = sorted(fractions, key=lambda cause: fractions[cause], reverse=True)
    parts = [
        f"{_CAUSES[c]} ({percent(min(fractions[c], 1))}" for c in ranked if fractions[c] >= _LEAST
    ]
    little = [_CAUSES[c] for c in ranked if fractions[c] < _LEAST]
    rmse = metrics.get("sensor.outside_cores.rmse_u", metrics["sensor.rmse_u"])
    text = f"u has an rms error of {rmse:.2g} m/s, limited by " + "), then ".join(
        [f"{parts[0]} of the mean square error", *parts[1:]]
    )
    return [f"{text})" + (f"; {' or '.join(little)}: negligible." if little else ".")]


def _not_stated(errors: PlatformErrors) -> list[str]:
    """A sentence on errors of the platform that standard errors do not include."""
    if errors == PlatformErrors():
        return []
    text = (
        "The platform's attitude, pointing or speed differs from the assumed one (sensor.errors). "
        "Standard errors do not include this error, which is common to all lines."
    )
    return [text]


def _costs(metrics: Mapping[str, float]) -> list[str]:
    pulses = metrics.get("sensor.doppler.pulses_needed")
    text = (
        f"The Doppler lidar's directions require {_rate(metrics, 'doppler')}, and give "
        f"{three(metrics['sensor.doppler.photons_per_direction'])} photons each"
        + (
            f"; the required error of v_LOS needs {pulses} pulse{'s' * (pulses != 1)} per "
            "direction."
            if pulses
            else "."
        )
        + f" The images require {_rate(metrics, 'backscatter')}."
    )
    safety = []
    for name, title in (("doppler", "Doppler"), ("backscatter", "backscatter")):
        distance = metrics.get(f"sensor.{name}.hazard_distance")
        if distance is None:
            continue
        aided = metrics[f"sensor.{name}.aided_hazard_distance"]
        where = "where it leaves"
        if aided > 0:
            where = f"beyond {three(distance)} m, with binoculars beyond {three(aided)} m"
        limit = three(metrics[f"sensor.{name}.permissible_exposure"])
        safety.append(
            f"The {title} lidar's beam is safe for eyes {where}: {limit} J/m² per pulse are "
            "permissible (IEC 60825-1:2014)."
        )
    return [text, *safety]


def _rate(metrics: Mapping[str, float], name: str) -> str:
    """Pulse rate of all directions of a lidar, its power, and beams needed at the same time."""
    rate, power, beams = (
        metrics[f"sensor.{name}.{key}"] for key in ("pulses_per_second", "average_power", "beams")
    )
    parallel = f", {beams} directions at a time" if beams > 1 else ""
    return f"{three(rate)} pulses per second{parallel}, {three(power)} W of light"


def _numbers(metrics: Mapping[str, float]) -> NumberTable:
    rows = []
    for key, label, unit in (
        ("rmse_{}", "rms error", "m/s"),
        ("outside_cores.rmse_{}", "rms error beyond cores", "m/s"),
        ("outside_cores.rms_{}", "the true wind itself there, rms", "m/s"),
        ("bias_{}", "bias", "m/s"),
        ("normalised_error_variance_{}", "variance of normalised errors", ""),
        ("coverage_68_{}", "within one standard error", "%"),
        ("coverage_95_{}", "within 1.96 standard errors", "%"),
        ("triples.rmse_{}", "rms error, lines of sight alone, triples", "m/s"),
        (
            "neighbours.rmse_{}",
            "rms error, lines of sight alone, up to nine by least squares",
            "m/s",
        ),
    ):
        values = [metrics.get(f"sensor.{key.format(name)}") for name in (*COMPONENTS, "v_los")]
        rows.append((label, unit, in_row(values, unit)))
    return "Errors against the truth", ["u", "v", "w", "v_LOS"], rows
