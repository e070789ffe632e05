"""Figures, animation and report of a flight, into its folder."""

from collections.abc import Mapping

import numpy as np

from lidar_mi.assessment.figures.encounter import draw_all
from lidar_mi.assessment.figures.encounter_film import MOST_FRAMES, film
from lidar_mi.assessment.metrics.encounter import CONTROLLER, judged_in_flight, measured_in_flight
from lidar_mi.assessment.metrics.requirements import Finding, RequirementTable, read_requirements
from lidar_mi.assessment.report.answer import verdict
from lidar_mi.assessment.report.encounter import encounter_answer, encounter_chapter
from lidar_mi.assessment.report.page import Film, page
from lidar_mi.encounter.doppler import at_the_slabs
from lidar_mi.encounter.flight import Flown, aircraft_of
from lidar_mi.encounter.folder import ANIMATION, FlightFolder
from lidar_mi.encounter.slabs import gates_of
from lidar_mi.encounter.wake import encounter_of
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.schema.reading import dump
from lidar_mi.io.film import frame_as_webp, write_gif


def write_report(
    kept: FlightFolder, experiment: Experiment, flown: Flown, metrics: Mapping[str, float], log: Log
) -> None:
    """Draw, and write figures, animation, report and metrics, these last."""
    log("drawing figures")
    span = float(np.ptp(aircraft_of(encounter_of(experiment)).strips.places[:, 1]))
    drawn = draw_all(kept.figures, flown.series, flown.track, flown.seen, span, log)
    chapter = encounter_chapter(
        metrics,
        judged(experiment, flown),
        drawn,
        _film(kept, flown, span, log),
        flown.series.attrs.get(CONTROLLER, ""),
    )
    found = answer(experiment, flown, metrics)
    html = page(
        at_the_slabs(experiment, gates_of(experiment)),
        dump(experiment),
        kept.record["versions"],
        metrics,
        [chapter],
        log.warnings,
        found,
        kept.data_files(),
    )
    kept.keep_verdict(metrics, html, found)


def answer(experiment: Experiment, flown: Flown, metrics: Mapping[str, float]) -> list[str]:
    """What a reader wants to know first, and the verdict on the lidar's wind, in sentences."""
    verdicts = [verdict(table, rows) for table, rows in judged(experiment, flown)]
    return [*encounter_answer(metrics, flown.series.attrs.get(CONTROLLER, "")), *verdicts]


def judged(experiment: Experiment, flown: Flown) -> list[tuple[RequirementTable, list[Finding]]]:
    """The lidar compared with the requirements as it measured in flight; empty without one."""
    if flown.track is None:
        return []
    encounter = encounter_of(experiment)
    stride = encounter.path.speed / encounter.rate
    depth = stride / max(1, round(stride / experiment.scan.thickness))
    measured = measured_in_flight(flown.series, flown.track, depth)
    return judged_in_flight(read_requirements(), measured, encounter.path.speed)


def _film(kept: FlightFolder, flown: Flown, span: float, log: Log) -> Film | None:
    """Frames for the report; the same as an animation in the folder."""
    pixels, frames, times = [], [], []
    for frame in film(flown.series, flown.track, flown.seen, span):
        log.bar("drawing the animation", len(frames) / MOST_FRAMES)
        pixels.append(frame.pixels)
        frames.append((frame_as_webp(frame.pixels), frame.caption))
        times.append(frame.time)
    if len(frames) < 2:
        return None
    # twice as slow as flown
    seconds = 2 * (times[-1] - times[0]) / (len(times) - 1)
    write_gif(kept.path / ANIMATION, pixels, seconds)
    return Film(
        "The flight",
        "Above: backscatter of the slab that is seen now, true cores (crosses) and tracked ones, "
        "and the wings of the aircraft at this moment. Middle: from above, what the lidar looks "
        "at. Below: roll angles.",
        frames,
        seconds,
    )
