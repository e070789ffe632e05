"""One experiment, start to end: truth, sensor, picture, estimate, verdict.

A run lives in one folder. Pictures are kept as soon as they are there; a run that was stopped
goes on with those, and everything after them is made again.
"""

from collections.abc import Callable
from pathlib import Path

from lidar_mi import __version__
from lidar_mi.assessment.report import page as report
from lidar_mi.errors import is_interrupt
from lidar_mi.experiment import reading as config
from lidar_mi.experiment.run_folder import Log, Notice, claim, read_record
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages import backscatter as backscatter_chain
from lidar_mi.experiment.stages import error_budget as budget_chain
from lidar_mi.experiment.stages import fringes as fringe_chain
from lidar_mi.experiment.stages import sensor as sensor_chain
from lidar_mi.experiment.stages import volume as volume_chain
from lidar_mi.experiment.stages import vortices as vortex_chain
from lidar_mi.io.json import write_json
from lidar_mi.io.text import write_text


def run(
    experiment: Experiment,
    folder: str | Path,
    beside: str | Path = ".",
    overwrite: bool = False,
    notice: Notice = lambda text, share: None,
) -> dict[str, float]:
    """Run an experiment into a folder and return its metrics.

    Parameters
    ----------
    experiment : Experiment
    folder : path
        Made if missing. If it holds a run of the same experiment, its pictures are used again.
    beside : path
        Folder in which files named by the experiment are looked for first.
    overwrite : bool
        Replace a run of a different experiment instead of refusing.
    notice : callable
        Told what is running.

    Raises
    ------
    InputError
        Bad input, or the folder holds another experiment.
    """
    return prepare(experiment, beside, notice)(folder, overwrite, notice)


def prepare(
    experiment: Experiment, beside: str | Path = ".", notice: Notice = lambda text, share: None
) -> Callable[[str | Path, bool, Notice], dict[str, float]]:
    """Check all that can be checked before anything is written; what it returns runs the rest.

    It takes ``folder``, ``overwrite`` and ``notice`` as `run` does, which see for errors.
    """
    chains = []
    if experiment.wake:
        looking = volume_chain if experiment.volume else backscatter_chain
        chains.append(looking.prepare(experiment, beside, notice))
    if experiment.wake and experiment.retrieval.error_budget:
        chains.append(budget_chain.prepare(experiment, beside))
    if experiment.doppler:
        chains.append(fringe_chain.prepare(experiment))
    if experiment.sensor:
        chains.append(sensor_chain.prepare(experiment, beside))
    if experiment.wake and (experiment.sensor or "vortex_fit" in experiment.retrieval.methods):
        chains.append(vortex_chain.prepare(experiment, beside))

    def start(folder: str | Path, overwrite: bool, notice: Notice) -> dict[str, float]:
        folder = Path(folder)
        claim(folder, experiment, beside, overwrite)
        log = Log(folder / "log.txt", notice)
        log(f"lidar-mi {__version__}, experiment {experiment.name}, seed {experiment.seed}")
        try:
            return _run(experiment, chains, folder, log)
        except Exception as error:
            if not is_interrupt(error):
                log.fail(error)
            raise

    return start


def _run(experiment, chains, folder: Path, log: Log) -> dict[str, float]:
    metrics, chapters = {}, []
    for chain in chains:
        found, chapter = chain(folder, log)
        metrics |= found
        chapters.append(chapter)
    write_json(folder / "metrics.json", metrics)
    versions = read_record(folder)["versions"]
    resolved = config.dump(experiment)
    page = report.page(experiment, resolved, versions, metrics, chapters, log.warnings)
    write_text(folder / "report.html", page)
    log("done")
    return metrics
