"""One experiment: truth, sensor, images, estimate, verdict.

A run may have a folder, where images are saved as soon as they are rendered. A stopped run is
resumed with them, and everything after them is computed again. `resumable_folder` decides which
files are saved and reused, `rendering.batches` stores the samples of unfinished images.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from lidar_mi import __version__
from lidar_mi.arguments import checked_arguments
from lidar_mi.assessment.metrics.names import timing_key
from lidar_mi.errors import InputError, is_interrupt
from lidar_mi.experiment.device import devices_in_words, on_its_device
from lidar_mi.experiment.folder.run_folder import RunFolder
from lidar_mi.experiment.graph import Graph, Stage, Store
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.magnitudes import unusual
from lidar_mi.experiment.pipeline import Results, stages_of
from lidar_mi.experiment.results import Run
from lidar_mi.experiment.truth.clear_air import in_air_of_its_site
from lidar_mi.progress import Notice, progress
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import dump

RESUMED = "start it again to resume the run"


@checked_arguments
def run(
    experiment: Experiment,
    folder: str | Path | None = None,
    *,
    beside: str | Path | None = None,
    overwrite: bool = False,
    notice: Notice | None = None,
) -> Run:
    """Run an experiment, in memory or into a folder.

    Parameters
    ----------
    experiment : Experiment
    folder : path, optional
        Created if missing. If it holds a run of the same experiment, its images are used again.
        Figures and a report are only made with a folder.
    beside : path, optional
        Folder in which files named by the experiment are searched first. Default: the folder of
        the experiment file.
    overwrite : bool
        Replace a run of a different experiment instead of refusing.
    notice : callable, optional
        Called with the name of the running step and its progress (0 to 1, or None). Default:
        shown on the terminal or in the notebook.

    Returns
    -------
    Run
        ``metrics`` (flat, SI units), ``wind`` (Dataset), ``scans``, ``truth``, ``vortices``, ...;
        displayed as tables, and by ``show()`` as an image or a report.

    Raises
    ------
    InputError
        Bad input, or the folder holds another experiment.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> experiment = lm.load_experiment(
    ...     "wake_backscatter",
    ...     wake={"spacing": "1 m"},
    ...     render={"samples_per_beam": 4, "max_order": 1},
    ...     retrieval={"methods": ["cc"], "stride": 8},
    ... )
    >>> result = lm.run(experiment)                        # doctest: +SKIP
    >>> result.metrics["backscatter.cc.rmse_v"]            # doctest: +SKIP
    >>> result.wind.sel(source="backscatter")["v"]         # doctest: +SKIP
    """
    if notice is None:
        with progress() as notice:
            return run(experiment, folder, beside=beside, overwrite=overwrite, notice=notice)
    return complete(prepare(experiment, beside, notice), folder, overwrite=overwrite)


def prepare(
    experiment: Experiment,
    beside: str | Path | None = None,
    notice: Notice = silent,
    known: Mapping[str, Any] | None = None,
) -> Run:
    """Run all checks that are possible before anything is rendered or written.

    experiment, beside, notice: as of `run`.
    known: results of stages, by name, of an experiment that agrees in the keys that these depend
        on: they are not computed again.

    Returns
    -------
    Run
        On the device that the experiment asks for, with the truth and the other results of the
        preflight; `complete` runs the rest.
    """
    if experiment.encounter is not None:
        raise InputError(
            f"encounter: {experiment.name} is a flight, not a run; expected lidar-mi fly (lm.fly)"
        )
    search_path = Path(experiment.folder if beside is None else beside)
    experiment = in_air_of_its_site(on_its_device(experiment), search_path)
    graph, log = stages_of(experiment), Log(notice)
    prepared = Run(experiment, cast(Results, dict(known or {})), log, search_path=search_path)
    for text in unusual(experiment):
        log.remark(text)
    # results first: a check may take those of any stage of the preflight
    for stage in graph:
        if stage.preflight and stage.name not in prepared.results:
            _carry_out(graph, stage, prepared)
    for stage in graph:
        if stage.check:
            graph.call(stage.check, prepared.results)
        for text in graph.call(stage.remarks, prepared.results) if stage.remarks else ():
            log.remark(text)
    return prepared


def complete(
    prepared: Run,
    folder: str | Path | None = None,
    *,
    overwrite: bool = False,
    shared: Store | None = None,
) -> Run:
    """Run the rest of a prepared experiment.

    Folder and errors are those of `run`; images are ``shared`` with other runs.
    """
    if folder is None:
        finish(prepared)
        prepared.log("done")
        return prepared
    prepared.folder = Path(folder)
    store = RunFolder(folder, prepared.experiment, prepared.search_path, shared)
    with store.claimed(overwrite):
        log = prepared.log
        # after the claim, which removes the log of another experiment
        log.path = store.log
        log(
            f"lidar-mi {__version__}, experiment {prepared.experiment.name}, "
            f"seed {prepared.experiment.seed}"
        )
        log(devices_in_words(prepared.experiment))
        try:
            finish(prepared, store)
            _report(prepared, store)
            log("done")
            return prepared
        except BaseException as error:
            # also interrupts, which are no Exception
            if is_interrupt(error):
                error.add_note(RESUMED)
            elif isinstance(error, Exception):
                log.fail(error)
                # the message of an InputError names the fault by itself
                if not isinstance(error, InputError):
                    error.add_note(f"traceback in {log.path}")
            raise


def finish(prepared: Run, store: Store | None = None, *, with_figures: bool = True) -> None:
    """Compute the stages that a prepared experiment lacks, and its metrics.

    prepared: from `prepare`; complete afterwards.
    store: stores the results, and has those of an earlier run.
    with_figures: with what only the report needs.
    """
    from lidar_mi.assessment.report.simulation import simulation_remark
    from lidar_mi.experiment.measure import measure

    graph = stages_of(prepared.experiment)
    for stage in graph:
        # the graph computes those on demand where another stage needs them
        left_out = stage.on_demand or (stage.figure_only and not with_figures)
        if stage.name not in prepared.results and not left_out:
            _carry_out(graph, stage, prepared, store)
    if prepared.scans:
        # for images of an earlier run, the time that they took
        seconds = sum(scan.attrs["render_seconds"] for scan in prepared.scans)
        prepared.seconds["render"] = seconds
    prepared.metrics = measure(prepared.experiment, prepared.results, prepared.seconds)
    remark = simulation_remark(prepared.experiment, prepared.metrics)
    if remark:
        prepared.log.remark(remark)


def _carry_out(graph: Graph, stage: Stage, run: Run, store: Store | None = None) -> None:
    start = time.perf_counter()
    results = cast(dict[str, Any], run.results)
    results[stage.name] = graph.compute(stage, results, run.log, run.search_path, store)
    if stage.timing:
        # several stages count as one step
        run.seconds[stage.timing] += time.perf_counter() - start


def _report(run: Run, store: RunFolder) -> None:
    """Draw the figures; write them, the metrics and the report."""
    from lidar_mi.assessment.report.page import page
    from lidar_mi.experiment.report import chapters

    drawn, seconds = chapters(run.experiment, run.results, run.metrics, store.figures, run.log)
    run.seconds |= seconds
    # figures are drawn from the metrics: their own duration comes last
    run.metrics |= {timing_key(step): round(value, 3) for step, value in seconds.items()}
    store.write_previews()
    resolved, versions = dump(run.experiment), store.record["versions"]
    html = page(
        run.experiment,
        resolved,
        versions,
        run.metrics,
        drawn,
        run.warnings,
        run.answer,
        store.data_files(),
    )
    store.store_verdict(run.metrics, html, run.answer)
