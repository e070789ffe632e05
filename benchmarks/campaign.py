"""A campaign against a plain loop over its points and against the same loop with multiprocessing.

Points are computed without figures by all sides, and each in a folder of its own by the campaign.
"""

import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lidar_mi.campaign.collect import collect
from lidar_mi.campaign.description import Campaign
from lidar_mi.campaign.engine import connected, execute, prepare_campaign
from lidar_mi.campaign.folder import Outcome, write_outcome
from lidar_mi.campaign.points import Points
from lidar_mi.experiment.folder.records import METRICS
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.run import finish, prepare
from lidar_mi.io.json import to_json
from lidar_mi.io.text import write_text
from lidar_mi.system.threads import use_threads

from .measure import in_turns
from .report import Comparison, Row, row

BASE = {
    "name": "point",
    "wake": {"vortex_pair": {"width": 30, "height": 20, "circulation": 150, "separation": 16}},
    "render": {"max_order": 1},
    "retrieval": {"methods": ["variational"], "stride": 4, "sources": "measured"},
}
SMALL, LARGE = 4, 2000
"""Samples per beam: points of tenths of a second, and of some seconds."""


def compare(repeats: int = 3, points: int = 24) -> Comparison:
    """Wall time of a point."""
    lines = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        clients = {
            count: stack.enter_context(connected(None, count, 1, silent)) for count in (1, 2)
        }
        context = multiprocessing.get_context("spawn")
        pool = stack.enter_context(context.Pool(2, use_threads, (1,)))
        use_threads(1)
        for samples, count in ((SMALL, points), (LARGE, max(points // 2, 2))):
            lines += _rows(folder, clients, pool, samples, count, repeats)
        lines += _costs(folder, clients[2])
    notes = (
        "Loop: prepare and finish of every point in one process, metrics written to a file. Pool: "
        "the same in two processes. Workers and pool are started before; what is done once for all "
        "points has a row of its own.",
    )
    return Comparison("Campaigns", "campaign", "loop or pool", tuple(lines), notes)


def _rows(folder: Path, clients: dict, pool: Any, samples: int, count: int, repeats: int):
    def campaign(workers: int) -> Callable[[int], float]:
        return lambda turn: _campaign(folder, clients[workers], samples, count, turn)

    tasks: dict[str, Callable[[int], Any]] = {
        "one": campaign(1),
        "two": campaign(2),
        "loop": lambda turn: _loop(_cases(folder, samples, count, turn)),
        "pool": lambda turn: _pool(pool, _cases(folder, samples, count, turn)),
    }
    timed = in_turns(tasks, repeats)
    seconds = {
        name: [(one.seconds - one.result) / count for one in found] for name, found in timed.items()
    }
    once = sorted(one.result for one in timed["one"])[repeats // 2]
    about = f"{count} points, {samples} samples a beam"
    added = [a - b for a, b in zip(seconds["one"], seconds["loop"], strict=True)]
    yield row(
        f"{about}: one worker", "time of a point", "s", seconds["one"], seconds["loop"], "lower"
    )
    yield row(
        f"{about}: two workers", "time of a point", "s", seconds["two"], seconds["pool"], "lower"
    )
    yield row(
        f"{about}: two workers, one",
        "time of a point",
        "s",
        seconds["two"],
        seconds["one"],
        "lower",
    )
    yield Row(f"{about}: one worker", "added to a point", "s", sorted(added)[len(added) // 2])
    yield Row(f"{about}", "checking all points and collecting, once", "s", once)


def _costs(folder: Path, client: Any, count: int = 1000) -> Iterator[Row]:
    """What a point costs beside its own computation: once each, of many points without work."""
    campaign, base = _described(SMALL, count, 0)
    out = folder / "costs"
    start = time.perf_counter()
    ready = prepare_campaign(Points(campaign, base, folder), out)
    checked = time.perf_counter()
    for number in range(count):
        place = ready.place(number)
        place.mkdir(parents=True)
        write_outcome(place, Outcome("done", "", {}, 0, 0))
        write_text(place / METRICS, to_json({f"metric_{k}": float(k) for k in range(200)}))
    written = time.perf_counter()
    collect(ready)
    collected = time.perf_counter()
    futures = client.map(abs, range(count), pure=False)
    client.gather(futures)
    scheduled = time.perf_counter()
    steps = {
        "checking its settings": checked - start,
        "writing its metrics": written - checked,
        "collecting 200 metrics": collected - written,
        "scheduling its task": scheduled - collected,
    }
    for name, seconds in steps.items():
        yield Row(f"{count} points without work", name, "s", seconds / count)


def _described(samples: int, count: int, turn: int) -> tuple[Campaign, dict]:
    base = BASE | {"render": BASE["render"] | {"samples_per_beam": samples}}
    return Campaign(name="bench", base="point", seed=turn, members=count), base


def _campaign(folder: Path, client: Any, samples: int, count: int, turn: int) -> float:
    """One campaign; seconds of what is done once, beside its points."""
    start = time.perf_counter()
    out = folder / "campaign"
    shutil.rmtree(out, ignore_errors=True)
    campaign, base = _described(samples, count, turn)
    ready = prepare_campaign(Points(campaign, base, folder), out)
    begun = time.perf_counter()
    with ready.claimed():
        state = execute(ready, client, watch=lambda state: None)
    ended = time.perf_counter()
    assert state.done == count
    collect(ready)
    return begun - start + time.perf_counter() - ended


def _loop(cases: list[tuple]) -> float:
    for case in cases:
        _point(*case)
    return 0.0


def _pool(pool: Any, cases: list[tuple]) -> float:
    pool.starmap(_point, cases, chunksize=1)
    return 0.0


def _cases(folder: Path, samples: int, count: int, turn: int) -> list[tuple]:
    campaign, base = _described(samples, count, turn)
    points = Points(campaign, base, folder)
    (folder / "loop").mkdir(exist_ok=True)
    return [(points.experiment(n), folder / "loop" / f"{n}.json") for n in range(count)]


def _point(experiment: Any, path: Path) -> None:
    run = prepare(experiment)
    finish(run, with_figures=False)
    write_text(path, to_json(run.metrics))
