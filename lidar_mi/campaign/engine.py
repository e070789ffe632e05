"""A campaign on `dask.distributed`: points are submitted to workers, results are files."""

import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dask
import xarray as xr
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed

from lidar_mi.arguments import checked_arguments
from lidar_mi.campaign.collect import collect
from lidar_mi.campaign.description import checked_campaign, read_campaign
from lidar_mi.campaign.folder import CampaignFolder, Outcome, create, read_base, signatures
from lidar_mi.campaign.points import Points
from lidar_mi.campaign.spawning import (
    check_spawning,
    quiet_loggers,
    refuse_while_importing,
    workers_started,
)
from lidar_mi.campaign.status import Status, count
from lidar_mi.campaign.worker import Prepare, carry_out, render_shared
from lidar_mi.errors import InputError, one_line
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.pipeline import stages_of, storing_stages
from lidar_mi.progress import Notice
from lidar_mi.schema.shipped import campaign_file

MOST_UNASKED = 100_000
"""Most points of a campaign that runs without confirmation."""

PATIENCE = 15.0
"""Longest time for a scheduler to answer, s."""

_ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

_TRIES = 10
"""Most workers that may be lost while they are made ready."""

_AT_ONCE = 4
"""Tasks per thread that the scheduler holds, so that no worker waits."""


@dataclass(repr=False)
class State(Status):
    """Progress of a running campaign.

    ``started`` is the clock at the start, ``finished_before`` that of points finished before.
    Without a dashboard its address is empty.
    """

    started: float = field(default_factory=time.monotonic)
    finished_before: int = 0
    workers: int = 0
    dashboard: str = ""

    def rate(self) -> float:
        """Points a second since the start; 0: none yet."""
        # the clock may not have moved yet
        return (self.finished - self.finished_before) / max(time.monotonic() - self.started, 1e-9)

    def remaining(self) -> float:
        """Seconds until the end at this rate."""
        rate = self.rate()
        return (self.total - self.finished) / rate if rate else float("nan")


Watcher = Callable[[State], None]
"""Called whenever a point has ended."""


@checked_arguments
def run_campaign(
    campaign: str | Path | Mapping[str, Any],
    folder: str | Path | None = None,
    *,
    client: Client | str | None = None,
    workers: int | None = None,
    threads: int = 1,
    quick: bool = False,
    confirmed: bool = False,
    lifetime: float | None = None,
    notice: Notice | None = None,
    watch: Watcher | None = None,
) -> xr.Dataset:
    """Run all points of a campaign that are not done, and collect them.

    Parameters
    ----------
    campaign : path or mapping
        A campaign file, the name of a shipped one, an experiment with variants, or the keys of a
        description.
    folder : path, optional
        Default: ``outputs/NAME``. A folder with a part of this campaign is completed.
    client : distributed.Client or str, optional
        Of any scheduler whose workers see this folder under the same path; or its address, or the
        file that it wrote. Default: processes on this machine.
    workers : int, optional
        Processes on this machine. Default: one per core.
    threads : int
        Of each worker.
    quick : bool
        The coarse version that the file describes.
    confirmed : bool
        Also with more than 100 000 points.
    lifetime : float, optional
        Seconds; no further point is started that would not end in time.
    notice : callable, optional
        Called with the running step before the first point, and its progress (0 to 1, or None).
    watch : callable, optional
        Called with a `State` whenever a point has ended.

    Returns
    -------
    xr.Dataset
        Metrics over the campaign's dimensions and members, with ``status``, ``message`` and
        ``folder`` of every point; as in the file ``campaign.nc``.

    Raises
    ------
    InputError
        An invalid description, too many points, the folder of another campaign, a scheduler without
        workers or with workers of another version, workers that do not start.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> table = lm.run_campaign("design_map", quick=True)         # doctest: +SKIP
    >>> table["sensor.rmse_u"].sel(sky="day").mean("member")     # doctest: +SKIP
    """
    refuse_while_importing()
    notice, watch = notice or silent, watch or (lambda state: None)
    ready = prepare_campaign(campaign, folder, quick=quick, confirmed=confirmed, notice=notice)
    with ready.claimed(), connected(client, workers, threads, notice) as connection:
        execute(ready, connection, watch=watch, lifetime=lifetime)
    return collect(ready, notice)


def prepare_campaign(
    campaign: str | Path | Mapping[str, Any] | Points,
    folder: str | Path | None = None,
    *,
    quick: bool = False,
    confirmed: bool = False,
    overrides: list[str] | None = None,
    notice: Notice = silent,
) -> CampaignFolder:
    """The folder of a campaign whose points were all checked; parameters of `run_campaign`."""
    if isinstance(campaign, Points):
        origin, points = campaign.campaign.name, campaign
    elif isinstance(campaign, Mapping):
        origin = "campaign"
        description = checked_campaign(campaign, origin)
        points = Points(description, *read_base(description, origin))
    else:
        origin = str(campaign_file(campaign))
        description = read_campaign(origin, overrides, quick=quick)
        points = Points(description, *read_base(description, origin))
    if len(points) > MOST_UNASKED and not confirmed:
        raise InputError(
            f"{origin}: {len(points)} points are not allowed unasked; expected at most "
            f"{MOST_UNASKED}, or --yes (confirmed=True)"
        )
    return create(points, folder or Path("outputs") / points.campaign.name, notice)


@contextmanager
def connected(
    client: Client | str | None, workers: int | None, threads: int, notice: Notice
) -> Iterator[Client]:
    """A client whose workers are ready.

    client: of a scheduler, its address, or the file that it wrote. Default: processes here.

    Raises InputError: a scheduler that does not answer, workers of another version.
    """
    if isinstance(client, Client):
        _make_ready(client, threads, own_cache=True)
        # the caller closes it
        yield client
        return
    if client is not None:
        with _client_of(client) as cluster_client:
            _make_ready(cluster_client, threads, own_cache=True)
            yield cluster_client
        return
    count = workers or os.cpu_count() or 1
    if count < 1:
        raise InputError(f"workers: {workers} is not allowed; expected 1 or more")
    notice(f"starting {count} workers", None)
    check_spawning(count)
    # a point fails by its own count of killed workers, not by that of the scheduler
    settings: dict[str, Any] = {
        "distributed.scheduler.allowed-failures": 10**6,
        "distributed.scheduler.worker-saturation": 1.1,
        "distributed.worker.multiprocessing-method": "spawn",
        # without dask's limit for malloc, by which every large array is mapped anew
        "distributed.nanny.pre-spawn-environ": dict.fromkeys(_ONE_THREAD, threads)
        # points run in separate threads, whose memory is otherwise mapped anew every time
        | {"MALLOC_ARENA_MAX": 1},
        "distributed.logging.distributed": "critical",
        # its profiler samples the workers a hundred times a second: a fifth of a short point's time
        "distributed.worker.profile.enabled": False,
        "distributed.worker.memory.monitor-interval": "1s",
        "distributed.admin.tick.interval": "1s",
    }
    # the cluster closes behind the yield, but faults in its start get the message of
    # workers_started
    with dask.config.set(settings), quiet_loggers(), ExitStack() as open_until_the_end:
        with workers_started():
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                # any free port: several campaigns may run on a machine
                dashboard_address=":0",
                silence_logs=50,
            )
            open_until_the_end.enter_context(cluster)
            # the default client belongs to the user's code
            cluster_client = open_until_the_end.enter_context(Client(cluster, set_as_default=False))
            cluster_client.wait_for_workers(1, timeout=60)
        _make_ready(cluster_client, threads, own_cache=False)
        yield cluster_client


def execute(
    folder: CampaignFolder, client: Client, *, watch: Watcher, lifetime: float | None = None
) -> State:
    """Submit the points that are not done, and wait for them.

    Returns
    -------
    State
        At the end; `State.finished` is below its total if the lifetime was too short.
    """
    name, total = folder.campaign.name, len(folder.points)
    state = State(name, total, dashboard=client.dashboard_link if _has_dashboard() else "")
    waiting = []
    for number in range(state.total):
        if folder.is_done(number):
            count(folder, number, state)
        else:
            waiting.append(number)
    # rate and slowest step are those of this start
    state.finished_before = state.finished
    state.seconds.clear()
    watch(state)
    _Dispatch(folder, client, state, watch, lifetime).run(waiting)
    return state


class _Dispatch:
    """Submits points in their order, after the renderings that they share.

    ``numbers`` are the points that the scheduler has, ``shared`` the renderings by signature,
    ``needed`` the numbers of unfinished points that need these images; ``longest`` is the duration
    of the longest point, s.
    """

    def __init__(
        self,
        folder: CampaignFolder,
        client: Client,
        state: State,
        watch: Watcher,
        lifetime: float | None,
    ) -> None:
        self.folder, self.client, self.state, self.watch = folder, client, state, watch
        self.path, self.session = str(folder.path.resolve()), uuid.uuid4().hex[:12]
        self.end = None if lifetime is None else state.started + lifetime
        self.longest = 0.0
        self.numbers: dict[Future[Outcome], int] = {}
        self.shared: dict[str, Future[int]] = {}

    def run(self, waiting: list[int]) -> None:
        """All of some points, in their order."""
        self.needed = signatures(self.folder.index, waiting)
        self.next = iter(waiting)
        # _submit adds to it while run iterates over it
        self.pending = as_completed(loop=self.client.loop)
        self._fill()
        for future in self.pending:
            self._finish(future)
            self._fill()

    def _fill(self) -> None:
        """Keep the scheduler busy, but let it hold only a few tasks."""
        # with no worker for a moment tasks are still handed over, or the loop would end
        threads = max(sum(self.client.nthreads().values()), 1)
        self.state.workers = len(self.client.nthreads())
        while len(self.numbers) < _AT_ONCE * threads:
            if self.end is not None and time.monotonic() + self.longest > self.end:
                break
            number = next(self.next, None)
            if number is None:
                break
            self._submit(number)
        self.state.running = min(len(self.numbers), threads)

    def _submit(self, number: int) -> None:
        first, ready = self._renderings(number)
        # a new key: dask returns the old result of a known key
        future = self.client.submit(
            carry_out,
            self.path,
            number,
            self.session,
            ready,
            first,
            key=f"point-{number}-{uuid.uuid4().hex[:8]}",
            pure=False,
        )
        self.numbers[future] = number
        self.pending.add(future)

    def _renderings(self, number: int) -> tuple[list[int], list[Future[int]]]:
        """Renderings that this point shares: indices of those that it submits, and all tasks."""
        images = self.folder.index[number].images
        # most points share nothing: their experiment need not be made here
        if all(self.needed[image] < 2 for image in images):
            return [], []
        stages = storing_stages(stages_of(self.folder.points.experiment(number)))
        first: list[int] = []
        tasks: list[Future[int]] = []
        for signature, stage in zip(images, stages, strict=True):
            # images that one point needs are rendered in its own task
            if self.needed[signature] > 1 and signature not in self.shared:
                first.append(len(tasks))
                self.shared[signature] = self.client.submit(
                    render_shared,
                    self.path,
                    number,
                    stage.name,
                    self.session,
                    key=f"render-{stage.name}-{signature[:8]}-{uuid.uuid4().hex[:8]}",
                    pure=False,
                )
            if signature in self.shared:
                tasks.append(self.shared[signature])
        return first, tasks

    def _finish(self, future: Future[Outcome]) -> None:
        """Count the outcome of a point, and remove images that no other point needs."""
        number = self.numbers.pop(future)
        try:
            outcome = future.result()
        except KilledWorker:
            # of a scheduler that gives up before the point's own count does
            self._submit(number)
            return
        except InputError:  # the folder, not the point
            raise
        except Exception as error:  # a failed point is an outcome
            raise InputError(
                f"the scheduler or its workers are lost ({one_line(error)[:100]}); start the "
                "campaign again to complete it"
            ) from error
        finally:
            future.release()
        # the longest so far: a point is started if even that one would end in time
        self.longest = max(self.longest, outcome.seconds.get("total", 0.0))
        self.state.add(outcome)
        self.watch(self.state)
        for signature in self.folder.index[number].images:
            self.needed[signature] -= 1
            if not self.needed[signature]:
                # without a future the scheduler forgets the task
                self.shared.pop(signature, None)
                self.folder.drop_images(signature)


def _client_of(address: str) -> Client:
    """A client of a scheduler by its address or by the file that it wrote."""
    file = Path(address).is_file()
    try:
        return Client(
            timeout=PATIENCE,
            set_as_default=False,
            **{"scheduler_file" if file else "address": str(address)},
        )
    except (OSError, ValueError) as error:
        reason = one_line(error).split(";")[0][:80]
        raise InputError(
            f"--scheduler: {address} does not answer within {PATIENCE:g} s ({reason}); expected "
            "the address of a running dask scheduler, tcp://HOST:8786, or its scheduler file"
        ) from None


def _make_ready(client: Client, threads: int, *, own_cache: bool) -> None:
    """Threads, kernel cache and version of all workers, those that come later included."""
    try:
        client.wait_for_workers(1, timeout=60)
    except TimeoutError:
        raise InputError(
            "--scheduler: no worker within 60 s; expected dask workers of this scheduler"
        ) from None
    for _ in range(_TRIES):
        try:
            client.register_plugin(Prepare(threads, own_cache))
            return
        except InputError:
            raise
        except OSError:  # a worker was lost meanwhile: its successor is made ready, too
            time.sleep(1.0)
        except Exception as error:
            raise InputError(
                f"--scheduler: its workers cannot load lidar-mi ({one_line(error)[:100]}); "
                "expected workers with the same version of it"
            ) from None
    raise InputError(
        f"--scheduler: workers were lost {_TRIES} times while they were made ready; expected "
        "workers that live longer"
    )


def _has_dashboard() -> bool:
    # without bokeh dask links to a page that only asks for it
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return False
    return True
