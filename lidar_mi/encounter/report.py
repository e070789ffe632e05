"""Figures, animation and report of an encounter, into its folder."""

from collections.abc import Mapping

import numpy as np

from lidar_mi.assessment.figures.encounter import draw_all
from lidar_mi.assessment.figures.encounter_film import MOST_FRAMES, film
from lidar_mi.assessment.metrics.encounter import (
    CONTROLLER,
    MET,
    judged_in_flight,
    measured_in_flight,
)
from lidar_mi.assessment.metrics.requirements import Finding, RequirementTable, read_requirements
from lidar_mi.assessment.report.answer import verdict
from lidar_mi.assessment.report.encounter import encounter_answer, encounter_chapter
from lidar_mi.assessment.report.page import Film, page
from lidar_mi.encounter.doppler import at_the_slabs
from lidar_mi.encounter.flight import FlightData, aircraft_of
from lidar_mi.encounter.folder import ANIMATION, EncounterFolder
from lidar_mi.encounter.slabs import gates_of
from lidar_mi.encounter.wake import encounter_of
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.schema.reading import dump
from lidar_mi.io.film import frame_as_webp, write_gif


def write_report(
    folder: EncounterFolder,
    experiment: Experiment,
    data: FlightData,
    metrics: Mapping[str, float],
    log: Log,
) -> None:
    """Draw, and write figures, animation, report and metrics, these last."""
    log("drawing figures")
    span = float(np.ptp(aircraft_of(encounter_of(experiment)).strips.places[:, 1]))
    drawn = draw_all(folder.figures, data.series, data.track, data.slabs, span, log)
    chapter = encounter_chapter(
        metrics,
        judged(experiment, data),
        drawn,
        _film(folder, data, span, log),
        data.series.attrs.get(CONTROLLER, ""),
        data.series.attrs.get(MET, "wake"),
    )
    found = answer(experiment, data, metrics)
    html = page(
        at_the_slabs(experiment, gates_of(experiment)),
        dump(experiment),
        folder.record["versions"],
        metrics,
        [chapter],
        log.warnings,
        found,
        folder.data_files(),
    )
    folder.write_verdict(metrics, html, found)


def answer(experiment: Experiment, data: FlightData, metrics: Mapping[str, float]) -> list[str]:
    """The main results, and the verdict on the lidar's wind, in sentences."""
    verdicts = [verdict(table, rows) for table, rows in judged(experiment, data)]
    about = data.series.attrs
    return [
        *encounter_answer(metrics, about.get(CONTROLLER, ""), about.get(MET, "wake")),
        *verdicts,
    ]


def judged(
    experiment: Experiment, data: FlightData
) -> list[tuple[RequirementTable, list[Finding]]]:
    """The lidar's measurements in flight compared with the requirements; empty without a lidar."""
    if data.track is None:
        return []
    encounter = encounter_of(experiment)
    stride = encounter.path.speed / encounter.rate
    depth = stride / max(1, round(stride / experiment.scan.thickness))
    measured = measured_in_flight(data.series, data.track, depth)
    return judged_in_flight(read_requirements(), measured, encounter.path.speed)


def _film(folder: EncounterFolder, data: FlightData, span: float, log: Log) -> Film | None:
    """Frames for the report; the same as an animation in the folder."""
    pixels: list[np.ndarray] = []
    frames: list[tuple[bytes, str]] = []
    times: list[float] = []
    for frame in film(data.series, data.track, data.slabs, span):
        log.bar("drawing the animation", len(frames) / MOST_FRAMES)
        pixels.append(frame.pixels)
        frames.append((frame_as_webp(frame.pixels), frame.caption))
        times.append(frame.time)
    if len(frames) < 2:
        return None
    # half the speed of the flight: the wake is crossed in a second or two
    seconds = 2 * (times[-1] - times[0]) / (len(times) - 1)
    write_gif(folder.path / ANIMATION, pixels, seconds)
    return Film(
        "The flight",
        "Above: backscatter of the slab that is seen now, true cores (crosses) and tracked ones, "
        "and the wings of the aircraft at this moment. Middle: from above, what the lidar looks "
        "at. Below: roll angles.",
        frames,
        seconds,
    )
