"""The answer of a run in a few sentences: its errors, and the verdict with its reasons."""

import math
from collections.abc import Iterator, Mapping, Sequence

from lidar_mi.assessment.digits import percent, whole_percent
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.names import (
    Source,
    bound_key,
    far_from_cores,
    has_no_skill,
    ring_key,
    vortex_key,
    wind_key,
)
from lidar_mi.assessment.metrics.requirements import (
    Finding,
    Judged,
    RequirementTable,
    as_rows,
    look_ahead,
)
from lidar_mi.assessment.metrics.velocities import READERS
from lidar_mi.assessment.report.coherent_lidar import coherent_answer
from lidar_mi.assessment.report.simulation import simulation_sentence
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.tables import with_error
from lidar_mi.units import shown

# Stated errors are reported as wrong if less than the first fraction of errors is within 1.96 of
# them, or more than the second within 1: four standard errors of these fractions for the eighty
# independent windows of 219 x 139 pixels. Judged if at least a fifth of the vectors is valid.
_COVERAGE_LIMITS, _LEAST_VALID = (0.85, 0.89), 0.2
# Standard errors of a circulation from which its error is named.
_LEAST_DEPARTURE = 3.0


def answer(experiment: Experiment, metrics: Mapping[str, float], judged: Judged = ()) -> list[str]:
    """The results of a run in sentences, on the terminal, in the report and in `summary.txt`.

    metrics: of a run.
    judged (sequence of (RequirementTable, list of Finding)): from
        `lidar_mi.experiment.measure.judged`.

    Returns
    -------
    list of str
        Sentences: which part of the error is the simulation's, unless it is as small as asked for;
        errors of the wind, vortices, what scatters back, and one verdict per requirement table.
        Tables of phases of flight at another air speed are named and not judged.
    """
    simulated = simulation_sentence(experiment, metrics)
    lines = [simulated] if simulated else []
    lines += [*_wind(experiment, metrics), *_wrong(experiment, metrics), *_vortices(metrics)]
    lines += _scatterers(metrics)
    speed = experiment.platform.speed if experiment.imaged_wake else 0.0
    lines += [verdict(table, findings) for table, findings in judged if table.applies_at(speed)]
    others = [table for table, _ in judged if not table.applies_at(speed)]
    phases = dict.fromkeys(f"{table.phase} ({_speeds(table)})" for table in others)
    lines += [f"{_capital(phase)}: not assessed at {shown(speed, 'm/s')}." for phase in phases]
    return lines


def verdict(table: RequirementTable, findings: Sequence[Finding]) -> str:
    """Compliance with one table: rows fulfilled, those that are not, and those not judged."""
    rows = as_rows(list(findings))
    fulfilled = sum(bool(f.passed) for f in findings)
    count = f"all {len(findings)}" if fulfilled == len(findings) else f"{fulfilled} of {len(rows)}"
    reasons = [f"{count} rows fulfilled"]
    for name, required, measured, _, state in rows:
        if state == "fail":
            reasons.append(f"{name} {measured} against {required}")
    unknown = [
        f"{row[0]} ({finding.reason})"
        for row, finding in zip(rows, findings, strict=True)
        if finding.reason
    ]
    if unknown:
        reasons.append(f"not judged: {', '.join(unknown)}")
    return f"{_capital(table.phase)}, {table.title}: {'; '.join(reasons)}."


def _wind(experiment: Experiment, metrics: Mapping[str, float]) -> Iterator[str]:
    """Errors of the wind from the most complete of the sensors that the run has."""
    if "sensor.vectors" in metrics:
        yield _sensor(experiment, metrics)
    elif f"{Source.BACKSCATTER}.mc_relative_error" in metrics:
        yield _images(experiment, metrics)
    elif experiment.fringes:
        yield from _rings(experiment.fringes, metrics)
    elif experiment.coherent:
        yield from coherent_answer(metrics)


def _sensor(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    head = f"Both lidars, {_place(experiment)}{_without_noise(experiment)}"
    if not metrics["sensor.vectors"]:
        return f"{head}: no valid wind vector."
    far = far_from_cores(metrics, "sensor.", "rmse_")
    # a component that is zero has no error
    components = "vw" if metrics.get(f"sensor.{far}rms_u") == 0 else "uvw"
    errors = _values(metrics, f"sensor.{far}rmse_", components)
    true = _values(metrics, f"sensor.{far}rms_", components)
    of_true = f" (true wind {true})" if true else ""
    valid, spanned = metrics["sensor.valid_fraction"], metrics.get("sensor.spanned_fraction", 1.0)
    between = " between the lines of sight" if spanned < 1 else ""
    return (
        f"{head}: rms errors of {', '.join(components)} {errors} m/s{_beyond(far)}{of_true}; "
        f"{whole_percent(valid / spanned)} of the vectors{between} are valid."
    )


def _images(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    source = Source.NOISY if experiment.detector else Source.BACKSCATTER
    components = "uvw" if "true_wind.rms_u" in metrics else "vw"
    far = far_from_cores(metrics, "true_wind.", "rms_")
    settings = experiment.volume or experiment.retrieval
    parts = []
    for method in settings.methods:
        valid = metrics.get(wind_key(source, method, "valid_fraction"))
        errors = _values(metrics, wind_key(source, method, f"{far}rmse_"), components)
        if valid is None:
            continue
        result = f"{errors} m/s ({whole_percent(valid)} valid)" if errors else "no valid vector"
        result = "no skill" if has_no_skill(metrics, source, method) else result
        parts.append(f"{METHOD_NAMES[method]} {result}")
    true = _values(metrics, f"true_wind.{far}rms_", components)
    return (
        f"Backscatter lidar, {_place(experiment)}{_without_noise(experiment)}: rms errors of "
        f"{', '.join(components)}"
        f"{_beyond(far)} by {'; '.join(parts)}; the true wind has {true} m/s."
    )


def _rings(doppler: Doppler, metrics: Mapping[str, float]) -> Iterator[str]:
    """The first method of analysis, for every number of images averaged."""
    settings = doppler.retrieval
    method, centre = settings.methods[0], settings.centre[0]
    parts = []
    for number in sorted(settings.averaged):
        keys = [ring_key(method, centre, number, name) for name in ("std", "bias")]
        if any(key not in metrics for key in keys):
            continue
        std, bias = (
            with_error(metrics[key], metrics.get(f"{key}_stderr", math.nan)) for key in keys
        )
        bound = metrics.get(bound_key(centre, number))
        limit = "" if bound is None else f" (Cramér-Rao bound {bound:.2g})"
        images = "one image" if number == 1 else f"{number} images"
        parts.append(f"of {images} {std} m/s{limit}, bias {bias} m/s")
    if parts:
        yield (
            f"Doppler lidar, {doppler.lidar.range:g} m ahead, {READERS[method]}: "
            f"standard deviation of the line-of-sight velocity {'; '.join(parts)}."
        )


def _wrong(experiment: Experiment, metrics: Mapping[str, float]) -> Iterator[str]:
    """Sentences on wrong standard errors of the winds that the answer names."""
    if "sensor.vectors" in metrics:
        yield from _misstated("both lidars", metrics, "sensor.", "uvw")
    elif experiment.imaged_wake:
        source = Source.NOISY if experiment.detector else Source.BACKSCATTER
        settings = experiment.volume or experiment.retrieval
        for method in settings.methods:
            head = wind_key(source, method, "")
            yield from _misstated(METHOD_NAMES[method], metrics, head, "uvw")


def _misstated(
    name: str, metrics: Mapping[str, float], head: str, components: str
) -> Iterator[str]:
    stated = [component for component in components if f"{head}coverage_95_{component}" in metrics]
    if not stated or metrics.get(f"{head}valid_fraction", 1.0) < _LEAST_VALID:
        return
    inner, outer = (
        sum(metrics[f"{head}coverage_{level}_{component}"] for component in stated) / len(stated)
        for level in (68, 95)
    )
    low, high = _COVERAGE_LIMITS
    if outer < low:
        size, covered = (
            "small",
            f"{whole_percent(outer)} of the errors are within 1.96 of them (95 %)",
        )
    elif inner > high:
        size, covered = "large", f"{whole_percent(inner)} of the errors are within 1 of them (68 %)"
    else:
        return
    yield f"Standard errors stated by {name} are too {size} here: {covered}."


def _vortices(metrics: Mapping[str, float]) -> Iterator[str]:
    """The fit to the wind vectors, or else to the images, where there is a true pair."""
    sides = ("port", "starboard")
    truth = [vortex_key("truth", f"{side}_circulation_5_15") for side in sides]
    for origin in ("vectors", "images"):
        keys = [vortex_key(origin, f"{side}_circulation_5_15") for side in sides]
        if any(metrics.get(key) is None for key in truth) or any(k not in metrics for k in keys):
            continue
        true = [metrics[key] for key in truth]
        fitted = [with_error(metrics[key], metrics.get(f"{key}_stderr", math.nan)) for key in keys]
        ratio = max(
            abs(metrics[key] - expected) / metrics.get(f"{key}_stderr", math.inf)
            for key, expected in zip(keys, true, strict=True)
        )
        beyond = f", off by up to {ratio:.2g} standard errors" if ratio > _LEAST_DEPARTURE else ""
        yield (
            f"Vortex pair: circulations {fitted[0]} and {fitted[1]} m²/s, true "
            f"{true[0]:.0f} and {true[1]:.0f} m²/s{beyond}."
        )
        return


def _without_noise(experiment: Experiment) -> str:
    return "" if experiment.detector else ", images without detector noise"


def _scatterers(metrics: Mapping[str, float]) -> Iterator[str]:
    """What scatters back, in one line."""
    names = {"molecules": "molecules", "background": "clear background", "exhaust": "exhaust"}
    parts = [
        f"{text} {percent(fraction)}"
        for key, text in names.items()
        if (fraction := metrics.get(f"backscatter.fraction.{key}", 0)) > 0
    ]
    if parts:
        yield f"Backscatter in the gate, mean over the image: {', '.join(parts)}."


def _place(experiment: Experiment) -> str:
    """Range of the slab and the time until the aircraft reaches it."""
    scan, speed = experiment.scan, experiment.platform.speed
    place = f"{scan.range:.6g} to {scan.range + scan.thickness:.6g} m ahead"
    if not speed:
        return place
    return f"{place} ({look_ahead(scan.range, speed):.2g} s at {shown(speed, 'm/s')})"


def _values(metrics: Mapping[str, float], key: str, components: str) -> str:
    """Numbers of all components, two digits; empty where one is not known."""
    values = [metrics.get(f"{key}{name}") for name in components]
    return "" if None in values else ", ".join(f"{value:#.2g}".rstrip(".") for value in values)


def _beyond(far: str) -> str:
    return " beyond two core radii" if far else ""


def _speeds(table: RequirementTable) -> str:
    if math.isinf(table.fastest):
        return f"from {table.slowest:.3g} m/s"
    low = f"{table.slowest:.3g} to " if table.slowest else "up to "
    return f"{low}{table.fastest:.3g} m/s"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
