"""Figures and report of a run, at its end and from its results alone."""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path

from lidar_mi.assessment.figures import backscatter as backscatter_figures
from lidar_mi.assessment.figures import coherent as coherent_figures
from lidar_mi.assessment.figures import doppler as doppler_figures
from lidar_mi.assessment.figures import error_budget as budget_figures
from lidar_mi.assessment.figures import pointing as pointing_figures
from lidar_mi.assessment.figures import sensor as sensor_figures
from lidar_mi.assessment.figures import volume as volume_figures
from lidar_mi.assessment.figures import vortices as vortex_figures
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.assessment.metrics.sensor import COMPONENTS
from lidar_mi.assessment.report.backscatter import backscatter_chapter
from lidar_mi.assessment.report.coherent import coherent_chapter
from lidar_mi.assessment.report.doppler import doppler_chapter
from lidar_mi.assessment.report.error_budget import budget_chapter
from lidar_mi.assessment.report.page import Chapter
from lidar_mi.assessment.report.pointing import pointing_chapter
from lidar_mi.assessment.report.sensor import sensor_chapter
from lidar_mi.assessment.report.vector_map import map_data
from lidar_mi.assessment.report.volume import volume_chapter
from lidar_mi.assessment.report.vortices import vortex_chapter
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.measure import judged
from lidar_mi.experiment.pipeline import Results
from lidar_mi.experiment.stages.winds import rendered_pairs
from lidar_mi.schema.experiment import Experiment

Metrics = Mapping[str, float]


def chapters(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> tuple[list[Chapter], dict[str, float]]:
    """Draw all figures into a folder and assemble the chapters of the report.

    There is one chapter for each instrument; the drawing's duration (s) is by step. Metrics are
    those of `lidar_mi.experiment.measure.measure`.
    """
    drawn_chapters: list[Chapter] = []
    seconds: dict[str, float] = defaultdict(float)
    log("drawing figures")
    # the wind behind a turbine is mostly u, which both lidars measure together
    first = "lines" if _behind_turbine(experiment) else None
    for result, step, chapter in sorted(_CHAPTERS, key=lambda row: row[0] != first):
        if results.get(result) is not None:
            start = time.perf_counter()
            drawn_chapters.append(chapter(experiment, results, metrics, folder, log))
            seconds[step] += time.perf_counter() - start
    return drawn_chapters, seconds


def _behind_turbine(experiment: Experiment) -> bool:
    return experiment.wake is not None and experiment.wake.turbine is not None


def _backscatter(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    winds, cores = results["wind"], results["cores"]
    drawn = backscatter_figures.draw_all(
        folder, results["truth"], results["scans"], winds, cores, results["texture_sweep"], log
    )
    source = Source.NOISY if experiment.detector else Source.BACKSCATTER
    wind = winds.sel(source=source)
    # the first method with a valid vector
    valid = (wind["flag"] == 0).any(("z", "y")).transpose("algorithm").values
    vectors = map_data(wind.isel(algorithm=int(valid.argmax())), ("v", "w"), cores)
    alone = () if experiment.sensor else judged(experiment, results, metrics)
    return backscatter_chapter(experiment, metrics, cores, drawn, alone, vectors)


def _volume(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    pair = results["volumes"].pairs[Source.BACKSCATTER]
    drawn = volume_figures.draw_all(folder, results["wind_volume"], pair, results["cores"], log)
    return volume_chapter(experiment, metrics, drawn)


def _pointing(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    pointing = results["pointing"]
    assert pointing is not None  # `chapters` leaves out those of None
    return pointing_chapter(metrics, pointing_figures.draw_all(folder, pointing, log))


def _error_budget(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    drawn = budget_figures.draw_all(folder, results["error_budget"], log)
    return budget_chapter(results["error_budget"], drawn)


def _doppler(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    doppler = experiment.fringes
    assert doppler is not None  # the results of this section
    drawn = doppler_figures.draw_all(
        folder,
        doppler,
        results["exposure"],
        results["lit_rings"].photons,
        results["v_los"],
        dict(metrics),
        log,
    )
    return doppler_chapter(doppler, metrics, drawn)


def _sensor(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    wind, cores = results["wind3d"], results["cores"]
    drawn_wind = wind if metrics["sensor.vectors"] else None
    drawn = sensor_figures.draw_all(folder, drawn_wind, results["lines"], cores, log)
    vectors = (
        None
        if wind is None
        else map_data(wind, COMPONENTS, cores, "u" if _behind_turbine(experiment) else "")
    )
    verdicts = judged(experiment, results, metrics)
    return sensor_chapter(experiment, metrics, verdicts, drawn, vectors)


def _coherent(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    lines, vortices = results["coherent_lines"], results.get("line_vortices")
    if vortices is not None:
        drawn = coherent_figures.draw_slices(folder, lines, vortices, log)
    elif "line_winds" in results:
        drawn = coherent_figures.draw_profiles(folder, results["line_winds"], log)
    else:
        drawn = coherent_figures.draw_stare(folder, lines, log)
    return coherent_chapter(metrics, drawn, vortices)


def _vortices(
    experiment: Experiment, results: Results, metrics: Metrics, folder: Path, log: Log
) -> Chapter:
    fits, truth = results["vortices"], results["truth"].wind
    (image, _), _ = list(call(rendered_pairs, experiment, scans=results["scans"]).values())[-1]
    drawn = vortex_figures.draw_all(
        folder, image, results["vectors"], truth, fits.pairs, results["cores"], log
    )
    return vortex_chapter(metrics, fits.pairs, fits.refused, drawn, fits.method)


# result of a chapter, step to which the time of its figures is added
_CHAPTERS: tuple[tuple[str, str, Callable[..., Chapter]], ...] = (
    ("wind", "figures", _backscatter),
    ("wind_volume", "figures", _volume),
    ("pointing", "figures", _pointing),
    ("error_budget", "figures", _error_budget),
    ("v_los", "doppler_figures", _doppler),
    ("coherent_lines", "figures", _coherent),
    ("lines", "figures", _sensor),
    ("vortices", "figures", _vortices),
)
