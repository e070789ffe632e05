"""Summary of an experiment before its run, with the checks of a run, in numbers."""

import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.assessment.digits import three
from lidar_mi.assessment.metrics.flow_checks import relative_divergence, sense_of_rotation
from lidar_mi.assessment.metrics.requirements import RequirementTable, look_ahead
from lidar_mi.atmosphere.vortices.cores import find_cores
from lidar_mi.experiment.describe import Section
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.pipeline import Results
from lidar_mi.experiment.preflight.coherent import coherent_rows, passage_rows
from lidar_mi.experiment.run import prepare
from lidar_mi.experiment.stages.eye_safety import scan_safety
from lidar_mi.experiment.stages.image_remarks import window_reach
from lidar_mi.experiment.stages.light_budget import (
    backscatter_fractions,
    fractions_in_words,
    light_budget,
)
from lidar_mi.experiment.stages.rendering import chosen_samples, samples_text
from lidar_mi.experiment.stages.sensor_cost import lidar_costs
from lidar_mi.experiment.stages.timed_beams import lines_schedule, scan_schedule
from lidar_mi.experiment.truth.clear_air import air_in_words
from lidar_mi.experiment.truth.in_time import values_of_states
from lidar_mi.instrument.doppler import DopplerLidar, photons
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.instrument.scan_timing import Schedule
from lidar_mi.progress import Notice, without_warnings
from lidar_mi.rendering.memory import ceiling
from lidar_mi.rendering.samples import Samples
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.sensor import Sensor
from lidar_mi.schema.wake import Wake
from lidar_mi.units import shown

LEAST_SHOWN = 0.5
"""Least time of a part of a run that is shown, s."""


def sections(
    experiment: Experiment,
    search_path: str | Path = ".",
    notice: Notice = silent,
    *,
    timed: bool = False,
    sampled: bool = False,
) -> Iterator[Section]:
    """Titled tables of an experiment's instruments and the observed air; nothing is written.

    search_path: folder in which files named by the experiment are searched first.
    notice: called with the name of the running step.
    timed: with the time of the run, which takes a probe of about a second.
    sampled: say of Monte Carlo samples, where there is a detector, how many are chosen and what
        their noise is relative to its own, which takes an image of few samples.

    Raises InputError: anything that a run would refuse before it starts.
    """
    # processor time, which other programs do not affect
    start = time.process_time()
    prepared = prepare(experiment, search_path, without_warnings(notice))
    experiment, results = prepared.experiment, prepared.results
    if timed and experiment.wake:
        _ = results["truth"].extinction[1]  # which a run advects
    preparation = time.process_time() - start
    chosen: Samples | None = None
    if experiment.imaged_wake:
        if sampled and experiment.detector:
            inputs = {name: results[name] for name in ("truth", "plans", "air", "flows")}
            chosen = call(chosen_samples, experiment, **inputs, log=Log(notice))
        yield from _backscatter(experiment, experiment.imaged_wake, results, chosen)
        if experiment.scan.timing:
            schedule = scan_schedule(experiment.scan, results["plans"][0], prepared.search_path)
            yield "scan of the backscatter lidar", _timing(experiment, schedule)
        yield (
            "eye safety (IEC 60825-1:2014)",
            _eye_safety(experiment, results, prepared.search_path),
        )
    if experiment.fringes:
        yield _doppler(experiment.fringes)
    if experiment.coherent:
        yield "coherent lidar", coherent_rows(experiment.coherent)
        yield "air that passes it", passage_rows(experiment.coherent, results["passing_air"])
    if experiment.sensor:
        yield _sensor(experiment.sensor, experiment.platform.speed, results["requirements"])
        if experiment.sensor.timing:
            yield (
                "scan of the Doppler lidar",
                _timing(
                    experiment, call(lines_schedule, experiment, search_path=prepared.search_path)
                ),
            )
    if timed:
        from lidar_mi.experiment.preflight.cost import with_number

        notice("timing a few samples and a retrieval", None)
        # with the chosen number: another choice would cost pilots
        sampled_experiment = with_number(experiment, chosen.number) if chosen else experiment
        rows = [*_time(sampled_experiment, results, preparation), _memory(experiment, results)]
        yield "cost of the run, to a factor of 2", rows
    else:
        yield "cost of the run", [_memory(experiment, results)]
    if prepared.warnings:
        yield f"{experiment.name}: warnings", [(text,) for text in prepared.warnings]


def _backscatter(
    experiment: Experiment, wake: Wake, results: Results, chosen: Samples | None
) -> Iterator[Section]:
    truth, plan = results["truth"], results["plans"][0]
    wind, extinction = truth.wind, truth.extinction[0]
    rows = [(axis, _span(wind[axis].values, "m")) for axis in ("y", "z")]
    rows += [(name, _span(wind[name].values, "m/s")) for name in ("u", "v", "w") if name in wind]
    if not wake.turbine:
        rows.append(("vortices", sense_of_rotation(wind, find_cores(wind))))
    divergence = relative_divergence(wind)
    # NaN without vorticity
    if divergence == divergence:
        rows.append(("divergence of v, w", f"{divergence:.2g} of the vorticity's rms"))
    rows.append(("extinction", _span(1e3 * extinction.values, "1/km")))
    rows.append(("texture, rms", f"{wake.texture.rms:.0%}"))
    title = wake.file or ("vortex_pair" if wake.vortex_pair else "turbine")
    yield f"{experiment.name}: extinction in the gates ({title}, about the scan's axis)", rows

    scan, lidar, platform = experiment.scan, experiment.lidar, experiment.platform
    pixel = float(plan.y[1] - plan.y[0]) if plan.y.size > 1 else float("nan")
    rows = [
        ("laser", _laser(lidar)),
        ("beam divergence", f"{shown(lidar.divergence_full, 'mrad')}, full angle at 1/e^2"),
        ("field of view", f"{shown(lidar.fov_half, 'mrad')}, half angle"),
        ("telescope radius", f"{lidar.aperture_radius:g} m"),
        ("beams", f"{plan.y.size} x {plan.z.size}, {pixel:.3g} m apart"),
        ("1/e^2 beam radius at the gates", f"{float(lidar.radius_at(plan.centre)):.3g} m"),
        ("gates", f"{scan.gate_count}, from {plan.gate_start:g} to {plan.gate_stop:g} m"),
        ("look-ahead time", _look_ahead(plan.gate_start, platform.speed)),
        ("samples per beam", _samples(experiment, chosen)),
        ("time between the images", f"{platform.dt:g} s"),
        ("second image", _second(experiment, wake)),
        *_light(experiment, results),
    ]
    if not experiment.volume:
        rows += _displacements(experiment, wind, plan)
    yield "backscatter lidar", rows


def _second(experiment: Experiment, wake: Wake) -> str:
    """Where the state at t2 is from."""
    if wake.stored is not None:
        return f"the state stored at {wake.stored:.15g} s"
    along = wake.second == "advect_3d" or call(Observation, experiment).moves_along
    return "air of the first, advected by " + ("u, v and w" if along else "v and w")


def _samples(experiment: Experiment, chosen: Samples | None) -> str:
    """Monte Carlo samples, and the variance of their noise over that of the detector's."""
    number: object = experiment.render.samples_per_beam
    if chosen:
        number = samples_text(experiment.render, chosen)
    elif number == "auto" and experiment.detector:
        number = "auto (how many: --forecast)"
    elif experiment.detector is None:
        number = experiment.render.without_detector(experiment.scan.gate_count)
    return f"{number}, orders 1 to {experiment.render.max_order}"


def _light(experiment: Experiment, results: Results) -> list[tuple[str, str]]:
    """What scatters, how much of it arrives, and with how much noise."""
    kind = experiment.scattering
    truth, plan, air = results["truth"], results["plans"][0], results["air"]
    clear = results["clear_air"]
    light = call(light_budget, experiment, truth=truth, plan=plan, air=air, clear_air=clear)
    fractions = call(backscatter_fractions, experiment, truth=truth, air=air, clear_air=clear)
    particles = kind.aerosol or kind.table
    kind_in_words = f"{kind.phase} {particles}" if particles else kind.phase.replace("_", "-")
    rows = [
        ("scattering", f"{kind_in_words}, lidar ratio {light.lidar_ratio:.3g} sr"),
        ("molecules", clear.origin),
        ("backscatter in the gates", fractions_in_words(fractions, kind)),
        ("overlap with the field of view", f"{light.overlap:.1%}"),
        ("two-way transmittance", f"{light.transmittance:.1%}"),
    ]
    if light.photoelectrons is not None:
        rows += [
            ("photoelectrons per pulse", f"{light.photoelectrons:.3g} in the median pixel"),
            ("noise of a pixel", f"{light.noise:.2g} of its signal"),
        ]
    return rows


def _time(experiment: Experiment, results: Results, preparation: float) -> list[tuple[str, str]]:
    """Time of the parts of a run on one core of this machine."""
    from lidar_mi.experiment.preflight.cost import cost

    estimate = cost(experiment, results, preparation)
    names = {
        "preparation": "reading, advection of the air",
        "rendering": "rendering (all cores share it)",
        "images": "wind from the images",
        "rings": "rings of the Doppler lidar",
        "lines": "lines of sight",
        "figures": "figures and report",
    }
    parts = estimate._asdict()
    rows = [
        (text, f"about {duration(parts[key])}")
        for key, text in names.items()
        if parts[key] >= LEAST_SHOWN
    ]
    return [*rows, ("all, on one core", f"about {duration(estimate.total)}")]


def _memory(experiment: Experiment, results: Results) -> tuple[str, str]:
    """Memory that a run takes, and that it may take."""
    beams = in_states = 0
    if experiment.imaged_wake:
        plan = results["plans"][0]
        beams = plan.y.size * plan.z.size
        in_states = call(
            values_of_states, experiment, flows=results["flows"], plans=results["plans"]
        )
    expected = call(Footprint, experiment).bytes(beams, in_states) / 1e9
    # an experiment without a wake has a Doppler lidar
    render = (
        experiment.render
        if experiment.wake or not experiment.fringes
        else experiment.fringes.render
    )
    allowed = ceiling(render.memory) / 1e9
    return "memory", f"about {expected:.2g} GB, at most {allowed:.3g} GB"


def duration(seconds: float) -> str:
    """A time in a suitable unit: 40 s, 3 min, 5 h, 12 days."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(seconds, 1):.0f} s"


def _displacements(
    experiment: Experiment, wind: xr.Dataset, plan: ScanPlan
) -> list[tuple[str, str]]:
    """The fastest wind and the fastest that windows of this size can follow, per axis."""
    settings = experiment.retrieval
    reach = window_reach(settings, experiment.platform, plan)
    fastest = max(float(np.abs(wind[name]).max()) for name in ("v", "w"))
    rows = [("methods", ", ".join(settings.methods))]
    if {ImageMethod.CC, ImageMethod.WS} & set(settings.methods):
        followed = f"winds up to {reach:.3g} m/s; largest here {fastest:.3g} m/s"
        rows.append(("search region", followed))
    return rows


def _eye_safety(
    experiment: Experiment, results: Results, search_path: Path
) -> list[tuple[str, str]]:
    """From which distance eyes are safe in the beams, as a run computes it."""
    safety = call(scan_safety, experiment, plans=results["plans"], search_path=search_path)
    if safety is None:
        return [("backscatter lidar", "not assessed: lidar.pulse_duration is 0")]
    beam = _safe(safety.hazard_distance, safety.aided_hazard_distance)
    rows = [
        ("one beam", beam),
        ("the whole scan", _safe(safety.scan_hazard_distance)),
        ("permissible", f"{safety.permissible_exposure:.3g} J/m^2 per pulse"),
    ]
    if experiment.sensor:
        slab = results["slab_wind"]
        cost = call(lidar_costs, experiment, slab_wind=slab, search_path=search_path)["doppler"]
        if cost.permissible_exposure is not None:
            distance = _safe(cost.hazard_distance, cost.aided_hazard_distance)
            rows.append(("Doppler lidar's beam", distance))
    return rows


def _safe(distance: float | None, aided: float | None = 0.0) -> str:
    """Where eyes are safe; None and infinity: nowhere."""
    if distance is None or math.isinf(distance):
        return "safe nowhere"
    text = f"safe beyond {three(distance)} m" if distance > 0 else "safe where it leaves"
    if aided is None or math.isinf(aided):
        return f"{text}, with binoculars nowhere"
    return f"{text}, with binoculars beyond {three(aided)} m" if aided > 0 else text


def _doppler(doppler: Doppler) -> Section:
    lidar = doppler.lidar
    return "Doppler lidar", [
        ("laser", _laser(lidar)),
        ("beam divergence", f"{shown(lidar.divergence_full, 'mrad')}, full angle at 1/e^2"),
        ("field of view", f"{shown(lidar.fov_half, 'mrad')}, half angle"),
        ("range bin", f"{lidar.range_bin:g} m about {lidar.range:g} m"),
        ("air", air_in_words(lidar)),
        ("photons of a pulse", f"{photons(lidar):.3g}"),
        ("methods", ", ".join(doppler.retrieval.methods)),
    ]


def _laser(lidar: BackscatterLidar | DopplerLidar) -> str:
    """Wavelength, energy and duration of a pulse."""
    parts = [shown(lidar.wavelength, "nm"), f"{shown(lidar.pulse_energy, 'mJ')} a pulse"]
    if lidar.pulse_duration:
        parts.append(shown(lidar.pulse_duration, "ns"))
    return ", ".join(parts)


def _timing(experiment: Experiment, schedule: Schedule) -> list[tuple[str, ...]]:
    """What a scan in time asks of the laser and of the scanner, and the distance flown."""
    distance = experiment.platform.speed * schedule.duration
    return [
        ("duration", f"{schedule.duration:.4g} s"),
        ("distance flown", f"{distance:.3g} m"),
        ("beams per second between turns", f"{schedule.beam_rate:.4g}"),
        ("angular rate", f"{math.degrees(schedule.load.rate):.4g} deg/s"),
        ("angular acceleration", f"{math.degrees(schedule.load.acceleration):.4g} deg/s^2"),
    ]


def _sensor(
    sensor: Sensor, speed: float, tables: Mapping[tuple[str, str], RequirementTable]
) -> Section:
    columns, rows = sensor.directions.columns, sensor.directions.rows
    count = columns * rows
    judged = [" ".join(key) for key, table in tables.items() if table.applies_at(speed)]
    # further checks are made by a run
    flat = "; all in one plane: no wind from both" if min(columns, rows) == 1 else ""
    return "both as one sensor", [
        ("lines of sight", f"{count}, {sensor.pulses} pulses each{flat}"),
        ("pulses per second", f"{count * sensor.pulses * sensor.slabs_per_second:g}"),
        ("v and w from", sensor.method),
        ("compliance with", ", ".join(judged) or "no requirements"),
    ]


def _look_ahead(distance: float, speed: float) -> str:
    return f"{look_ahead(distance, speed):.3g} s at {shown(speed, 'm/s')}" if speed else "at rest"


def _span(values: np.ndarray, unit: str) -> str:
    return f"{values.min():.4g} to {values.max():.4g} {unit}"
