"""The tasks of a worker: one point, or images that several points share.

The scheduler handles paths and numbers only. Everything else is read from the campaign's folder and
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
from typing import Any, cast

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
from lidar_mi.experiment.folder import records
from lidar_mi.experiment.folder import run_folder as resumable_folder
from lidar_mi.experiment.folder.image_store import ImageStore
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.pipeline import stages_of, storing_stages
from lidar_mi.experiment.results import Run
from lidar_mi.experiment.run import complete, finish, prepare
from lidar_mi.io.folder import make_folder
from lidar_mi.io.json import to_json
from lidar_mi.io.text import append_line, read_text, write_text
from lidar_mi.io.yaml import to_yaml
from lidar_mi.schema.experiment import Experiment
from lidar_mi.system.threads import use_threads

MOST_ATTEMPTS = 3
"""A point that has killed so many workers fails."""


class Prepare(WorkerPlugin):
    """Makes a worker ready: its version, threads, kernel cache.

    threads: of Dr.Jit and of torch.
    own_cache: kernels are compiled for one machine. A home folder that machines share must not hold
        their cache: it is then in the machine's folder for temporary files.
    """

    name = "lidar-mi"

    def __init__(self, threads: int = 1, own_cache: bool = False) -> None:
        self.threads, self.own_cache, self.version = threads, own_cache, __version__

    def setup(self, worker: Worker) -> None:
        """Called by the worker when it starts, or when it receives this plugin.

        Raises InputError: the worker has another version of the package.
        """
        # a campaign of two versions would compare what is not comparable
        if self.version != __version__:
            raise InputError(
                f"worker {worker.address}: has lidar-mi {__version__}; expected {self.version}, as "
                "of the client"
            )
        if self.own_cache and "DRJIT_CACHE_DIR" not in os.environ:
            # all users of a machine have one folder for temporary files
            cache = Path(tempfile.gettempdir()) / f"lidar-mi-{os.getuid()}" / platform.node()
            make_folder(cache)
            os.environ["DRJIT_CACHE_DIR"] = str(cache)
        use_threads(self.threads)


def carry_out(
    folder: str, number: int, session: str, ready: Sequence[int] = (), first: Sequence[int] = ()
) -> Outcome:
    """Run one point, unless it is done.

    folder: of the campaign.
    session: a name for this start of the campaign: workers killed by a point are counted within it.
    ready: number of images rendered by each `render_shared` that precedes this point.
    first: indices of those that count as rendered by this point; other points re-use them.

    Returns
    -------
    Outcome
        A failure is one, with its message.
    """
    campaign = _opened(folder, (Path(folder) / RECORD).stat().st_mtime_ns)
    place = campaign.place(number)
    # the outcome is written before the metrics, by which the point is done
    if campaign.is_done(number) and (recorded := campaign.outcome(number)) is not None:
        return recorded
    make_folder(place)
    log = Log(path=place / records.LOG)
    start = time.perf_counter()
    store: PointStore | None = None
    try:
        # first, as anything later may kill the worker
        _count_attempt(place, session)
        experiment = campaign.points.experiment(number)
        store = PointStore(campaign, number, experiment)
        if experiment.encounter is not None:
            folder_of_flights = place / RUN if campaign.campaign.keep == "everything" else None
            flights = fly(experiment, folder_of_flights, overwrite=True, notice=silent)
            seconds, metrics = {}, flights.metrics
        else:
            run = _prepared(experiment, campaign.points.search_path)
            run.log.path = log.path
            _compute(campaign, run, store)
            seconds, metrics = run.seconds, run.metrics
        seconds = {"total": time.perf_counter() - start, **seconds}
        # rendered for this point by another task, so that the store has them
        shared = sum(ready[k] for k in first)
        rounded = {step: round(value, 4) for step, value in seconds.items()}
        outcome = Outcome("done", "", rounded, store.rendered + shared, store.reused - shared)
        # metrics last: they say that the point is done
        write_outcome(place, outcome)
        write_text(place / records.METRICS, to_json(metrics))
    except Exception as error:
        # an outcome, not an exception: one point must not end the campaign
        log.fail(error)
        counts = (store.rendered, store.reused) if store else (0, 0)
        message = one_line(error) or type(error).__name__
        outcome = Outcome("failed", message, {"total": time.perf_counter() - start}, *counts)
        write_outcome(place, outcome)
    # only killed workers count as attempts
    (place / ATTEMPTS).unlink(missing_ok=True)
    return outcome


def render_shared(folder: str, number: int, name: str, session: str) -> int:
    """Render the images of one stage, which several points share; present ones stay.

    Folder and session are those of `carry_out`; the number is that of one of the points. It returns
    how many were rendered. A fault that prevents it occurs in each of the points again, which
    report it.
    """
    campaign = _opened(folder, (Path(folder) / RECORD).stat().st_mtime_ns)
    experiment = campaign.points.experiment(number)
    store, graph = PointStore(campaign, number, experiment), stages_of(experiment)
    pairs = zip(storing_stages(graph), campaign.index[number].images, strict=True)
    stage, signature = next((stage, image) for stage, image in pairs if stage.name == name)
    images = campaign.images(signature)
    make_folder(images)
    try:
        _count_attempt(images, session)
        run = _prepared(experiment, campaign.points.search_path)
        graph.compute(stage, dict(run.results), run.log, run.search_path, store)
    except Exception:
        return store.rendered
    (images / ATTEMPTS).unlink(missing_ok=True)
    return store.rendered


def run_point(folder: CampaignFolder, number: int) -> Outcome:
    """Run one point in this process, unless it is done; several processes may run different ones.

    Images that only this point needs are removed afterwards.
    """
    use_threads(1)
    outcome = carry_out(str(folder.path.resolve()), number, uuid.uuid4().hex[:12])
    counts = signatures(folder.index, range(len(folder.points)))
    for signature in folder.index[number].images:
        if counts[signature] == 1:
            folder.drop_images(signature)
    return outcome


class PointStore:
    """Storage of a point's results: images shared by content, estimates with ``keep: estimates``.

    ``rendered`` and ``reused`` count images.
    """

    def __init__(self, campaign: CampaignFolder, number: int, experiment: Experiment) -> None:
        self._keep, self.place = campaign.campaign.keep, campaign.place(number)
        self._experiment, self.signature = experiment.name, campaign.index[number].point
        graph = stages_of(experiment)
        pairs = zip(storing_stages(graph), campaign.index[number].images, strict=True)
        of = {part: signature for stage, signature in pairs for part in graph.parts(stage)}
        self.images = ImageStore(lambda part: campaign.images(of[part]), of.__getitem__)
        self.rendered = self.reused = 0

    def stored(self, part: str) -> xr.Dataset | None:
        """An image of this content, rendered by any point."""
        image = self.images.stored(part)
        self.reused += image is not None
        return image

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
        """Write an estimate, if the campaign asks for it."""
        if self._keep == "estimates":
            resumable_folder.write_result(self.place, name, value, self._experiment, self.signature)


def _compute(campaign: CampaignFolder, run: Run, store: PointStore) -> None:
    """Run the stages of a point that are not prepared."""
    if campaign.campaign.keep == "everything":
        complete(run, store.place / RUN, overwrite=True, shared=store)
        return
    record = resumable_folder.new_record(run.experiment, campaign.points.search_path)
    write_text(store.place / records.RECORD, to_yaml(record))
    # figures are only for the report
    finish(run, store, with_figures=False)


# of the last point of this process: signatures and results of the stages that runs can share
_last: tuple[dict[str, str], dict[str, Any]] = ({}, {})


def _prepared(experiment: Experiment, search_path: Path) -> Run:
    """A prepared run, with the results that it shares with the last point of this process."""
    global _last
    signatures = _signatures(experiment, search_path)
    last_signatures, results = _last
    reusable = {
        name: results[name] for name in results if last_signatures[name] == signatures.get(name)
    }
    run = prepare(experiment, search_path, known=reusable)
    results = cast(dict[str, Any], run.results)
    shared = {name: results[name] for name in signatures if name in results}
    _last = ({name: signatures[name] for name in shared}, shared)
    return run


def _signatures(experiment: Experiment, search_path: Path) -> dict[str, str]:
    """Signatures of the results of the preflight, which runs can share."""
    record = resumable_folder.new_record(experiment, search_path)
    graph = stages_of(experiment)
    return {
        stage.name: resumable_folder.made_by(record, graph.keys(stage))
        for stage in graph
        if stage.preflight
    }


def _count_attempt(place: Path, session: str) -> None:
    """Count an attempt; InputError if `MOST_ATTEMPTS` of this session killed their worker."""
    # counted in a file, as a killed worker cannot count
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


@lru_cache(1)
def _opened(folder: str, changed: int) -> CampaignFolder:
    """A campaign's folder, read once by every worker and again once it has changed."""
    campaign = open_folder(folder)
    check_version(campaign)
    return campaign
