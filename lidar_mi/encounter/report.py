"""Figures, animation and report of an encounter, into its folder."""

from collections.abc import Mapping

import numpy as np

from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.assessment.figures.encounter import draw_all
from lidar_mi.assessment.figures.encounter_film import RATE, film, frame_times
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
from lidar_mi.encounter.flight import FlightData
from lidar_mi.encounter.folder import ANIMATION, VIDEO, EncounterFolder
from lidar_mi.encounter.lidar.doppler import at_the_slabs
from lidar_mi.encounter.lidar.slabs import gates_of
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.film import VIDEO_EXTRA, as_mp4, frame_as_webp, write_gif
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import dump

# Frames of a report without a video.
_SLIDER_FRAMES = 40
_FILM = "The flight, in real time"
_FILM_CAPTION = (
    "Above: backscatter and wind of the slab that was delivered last, true cores (crosses) and "
    "tracked ones, and the wings of the aircraft at this moment. Middle: from above, what the "
    "lidar looks at while it scans. Below: roll angles."
)


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
    verdict = answer(experiment, data, metrics)
    html = page(
        at_the_slabs(experiment, gates_of(experiment)),
        dump(experiment),
        folder.record["versions"],
        metrics,
        [chapter],
        log.warnings,
        verdict,
        folder.data_files(),
    )
    folder.write_verdict(metrics, html, verdict)


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
    """A video for the report and the folder, or frames with a slider; an animation beside them."""
    pixels: list[np.ndarray] = []
    captions: list[str] = []
    number = len(frame_times(data.series, data.track, data.slabs))
    if number < 2:
        return None
    for frame in film(data.series, data.track, data.slabs, span):
        if len(pixels) % RATE == 0:
            log.bar("drawing the animation", len(pixels) / number)
        pixels.append(frame.pixels)
        captions.append(frame.caption)
    log.bar("writing the animation", None)
    # half of the frames, as GIF hardly compresses them
    write_gif(folder.path / ANIMATION, pixels[::2], 2 / RATE)
    video = as_mp4(pixels, 1 / RATE)
    if video:
        write_atomically(folder.path / VIDEO, video)
        # one frame is shown before the video plays
        every, chosen = number, [number // 2]
    else:
        log(VIDEO_EXTRA)
        every = max(1, round(number / _SLIDER_FRAMES))
        chosen = list(range(0, number, every))
    frames = [(frame_as_webp(pixels[k]), captions[k]) for k in chosen]
    return Film(_FILM, _FILM_CAPTION, frames, every / RATE, video, ANIMATION)
