"""What a worker does: one point, or images that several points share.

The scheduler sees paths and numbers only. Everything else is read from the campaign's folder and
written there.
"""

import os
import platform
import tempfile
import time
import uuid
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import xarray as xr
from distributed import Worker, WorkerPlugin

from lidar_mi import __version__
from lidar_mi.campaign.folder import (
    ATTEMPTS,
    RECORD,
    RUN,
    CampaignFolder,
    Outcome,
    check_version,
    open_folder,
    signatures,
    write_outcome,
)
from lidar_mi.encounter.fly import fly
from lidar_mi.errors import InputError, one_line
from lidar_mi.experiment.folder import run_folder as resumable_folder
from lidar_mi.experiment.folder.image_store import ImageStore
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.pipeline import stages_of, storing_stages
from lidar_mi.experiment.results import Run
from lidar_mi.experiment.run import complete, finish, prepare
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.io.folder import make_folder
from lidar_mi.io.json import to_json
from lidar_mi.io.text import append_line, read_text, write_text
from lidar_mi.io.yaml import to_yaml
from lidar_mi.system.threads import use_threads

MOST_ATTEMPTS = 3
"""A point that has killed so many workers is given up."""


class Prepare(WorkerPlugin):
    """Makes a worker ready: its version, threads, kernel cache.

    Parameters
    ----------
    threads : int
        Of Dr.Jit and of torch.
    own_cache : bool
        Kernels are compiled for one machine. A home folder that machines share must not hold their
        cache: it is then in the machine's folder for temporary files.
    """

    name = "lidar-mi"

    def __init__(self, threads: int = 1, own_cache: bool = False):
        self.threads, self.own_cache, self.version = threads, own_cache, __version__

    def setup(self, worker: Worker) -> None:
        """Called by the worker when it starts, or when it is given this plugin.

        Raises
        ------
        InputError
            The worker has another version of the package.
        """
        if self.version != __version__:
            raise InputError(
                f"worker {worker.address}: has lidar-mi {__version__}; expected {self.version}, as "
                "of the client"
            )
        if self.own_cache and "DRJIT_CACHE_DIR" not in os.environ:
            cache = Path(tempfile.gettempdir()) / f"lidar-mi-{os.getuid()}" / platform.node()
            make_folder(cache)
            os.environ["DRJIT_CACHE_DIR"] = str(cache)
        use_threads(self.threads)


def carry_out(
    folder: str, number: int, session: str, ready: Sequence[int] = (), first: Sequence[int] = ()
) -> Outcome:
    """Run one point, unless it is done.

    Parameters
    ----------
    folder : str
        Of the campaign.
    number : int
    session : str
        A name for this start of the campaign: workers killed by a point are counted within it.
    ready : sequence of int
        Images that each `render_shared` has rendered, which this point had to wait for.
    first : sequence of int
        Which of these are counted as rendered by this point; others re-use them.

    Returns
    -------
    Outcome
        A failure is one, with its message.
    """
    campaign = _opened(folder, (Path(folder) / RECORD).stat().st_mtime_ns)
    place = campaign.place(number)
    if campaign.is_done(number):
        found = campaign.outcome(number)
        assert found is not None
        return found
    make_folder(place)
    log = Log(path=place / resumable_folder.LOG)
    start = time.perf_counter()
    keeper: PointKeeper | None = None
    try:
        _begin(place, session)
        experiment = campaign.points.experiment(number)
        keeper = PointKeeper(campaign, number, experiment)
        if experiment.encounter is not None:
            kept = place / RUN if campaign.campaign.keep == "everything" else None
            flight = fly(experiment, kept, overwrite=True, notice=silent)
            seconds, metrics = {}, flight.metrics
        else:
            run = _prepared(experiment, campaign.points.beside)
            run.log.path = log.path
            _compute(campaign, run, keeper)
            seconds, metrics = run.seconds, run.metrics
        seconds = {"total": time.perf_counter() - start, **seconds}
        before = sum(ready[k] for k in first)
        outcome = Outcome(
            "done", "", _rounded(seconds), keeper.rendered + before, keeper.reused - before
        )
        # metrics last: they say that the point is done
        write_outcome(place, outcome)
        write_text(place / resumable_folder.METRICS, to_json(metrics))
    except Exception as error:
        log.fail(error)
        counts = (keeper.rendered, keeper.reused) if keeper else (0, 0)
        message = one_line(error) or type(error).__name__
        outcome = Outcome("failed", message, {"total": time.perf_counter() - start}, *counts)
        write_outcome(place, outcome)
    (place / ATTEMPTS).unlink(missing_ok=True)
    return outcome


def render_shared(folder: str, number: int, name: str, session: str) -> int:
    """Render the images of one stage, which several points share; those that are there stay.

    Parameters
    ----------
    folder, session
        As of `carry_out`.
    number : int
        One of the points.
    name : str
        Of that stage.

    Returns
    -------
    int
        Number of images rendered. A fault that prevents it is found again, and reported, by each of
        the points.
    """
    campaign = _opened(folder, (Path(folder) / RECORD).stat().st_mtime_ns)
    experiment = campaign.points.experiment(number)
    keeper = PointKeeper(campaign, number, experiment)
    graph = stages_of(experiment)
    stages, signatures_ = storing_stages(graph), campaign.index[number].images
    stage, signature = next(
        (stage, one) for stage, one in zip(stages, signatures_, strict=True) if stage.name == name
    )
    images = campaign.images(signature)
    make_folder(images)
    try:
        _begin(images, session)
        run = _prepared(experiment, campaign.points.beside)
        graph.compute(stage, dict(run.results), run.log, run.search_path, keeper)
    except Exception:
        return keeper.rendered
    (images / ATTEMPTS).unlink(missing_ok=True)
    return keeper.rendered


def run_point(folder: CampaignFolder, number: int) -> Outcome:
    """Run one point in this process, unless it is done; several processes may run different ones.

    Images that only this point needs are removed afterwards.
    """
    use_threads(1)
    outcome = carry_out(str(folder.path.resolve()), number, uuid.uuid4().hex[:12])
    needed = signatures(folder.index, range(len(folder.points)))
    for signature in folder.index[number].images:
        if needed[signature] == 1:
            folder.drop_images(signature)
    return outcome


class PointKeeper:
    """Storage of a point's results: images shared by content, estimates as the campaign asks.

    Attributes
    ----------
    images : ImageStore
    rendered, reused : int
        Images.
    """

    def __init__(self, campaign: CampaignFolder, number: int, experiment: Experiment):
        self._keep, self.place = campaign.campaign.keep, campaign.place(number)
        self._experiment, self.signature = experiment.name, campaign.index[number].point
        graph = stages_of(experiment)
        pairs = zip(storing_stages(graph), campaign.index[number].images, strict=True)
        of = {part: one for stage, one in pairs for part in graph.parts(stage)}
        self.images = ImageStore(lambda part: campaign.images(of[part]), of.__getitem__)
        self.rendered = self.reused = 0

    def stored(self, part: str) -> xr.Dataset | None:
        """An image of this content, from whichever point rendered it."""
        found = self.images.stored(part)
        self.reused += found is not None
        return found

    def unfinished(self, part: str) -> dict[str, Any] | None:
        """As of `ImageStore`."""
        return self.images.unfinished(part)

    def store_unfinished(self, part: str, arrays: dict[str, Any]) -> None:
        """As of `ImageStore`."""
        make_folder(self.images.folder_of(part))
        self.images.store_unfinished(part, arrays)

    def store_part(self, part: str, value: xr.Dataset) -> xr.Dataset:
        """As of `ImageStore`."""
        make_folder(self.images.folder_of(part))
        self.rendered += 1
        return self.images.store_part(part, value)

    def store_result(self, name: str, value: Any) -> None:
        """Write an estimate, if estimates are kept."""
        if self._keep == "estimates":
            resumable_folder.write_result(self.place, name, value, self._experiment, self.signature)


def _compute(campaign: CampaignFolder, run: Run, keeper: PointKeeper) -> None:
    """Run the rest of a point."""
    if campaign.campaign.keep == "everything":
        complete(run, keeper.place / RUN, overwrite=True, shared=keeper)
        return
    record = resumable_folder.new_record(run.experiment, campaign.points.beside)
    write_text(keeper.place / resumable_folder.RECORD, to_yaml(record))
    finish(run, keeper, with_figures=False)


_last: tuple[dict[str, str], dict[str, Any]] = ({}, {})


def _prepared(experiment: Experiment, beside: Path) -> Run:
    """A prepared run, with what the last point of this process has in common with it."""
    global _last
    signatures = _signatures(experiment, beside)
    before, results = _last
    known = {name: results[name] for name in results if before[name] == signatures.get(name)}
    run = prepare(experiment, beside, known=known)
    shared = {name: run.results[name] for name in signatures if name in run.results}
    _last = ({name: signatures[name] for name in shared}, shared)
    return run


def _signatures(experiment: Experiment, beside: Path) -> dict[str, str]:
    """Signatures of the results of the preflight, which runs can share."""
    record, graph = resumable_folder.new_record(experiment, beside), stages_of(experiment)
    return {
        stage.name: resumable_folder.made_by(record, graph.keys(stage))
        for stage in graph
        if stage.preflight
    }


def _begin(place: Path, session: str) -> None:
    """Count an attempt.

    Raises
    ------
    InputError
        Earlier ones of this session have ended with their worker.
    """
    path = place / ATTEMPTS
    lines = read_text(path, "attempts").splitlines() if path.is_file() else []
    ended = lines.count(session)
    if ended >= MOST_ATTEMPTS:
        path.unlink()
        raise InputError(
            f"given up: its worker was killed {ended} times; expected a point that memory and "
            "libraries of the machine can hold"
        )
    append_line(path, session)


def _rounded(seconds: dict[str, float]) -> dict[str, float]:
    return {step: round(value, 4) for step, value in seconds.items()}


@lru_cache(1)
def _opened(folder: str, changed: int) -> CampaignFolder:
    """A campaign's folder as it was then: read once by every worker."""
    campaign = open_folder(folder)
    check_version(campaign)
    return campaign
