"""Retrievals on one thread and on torch's default number, alone and with other load."""

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from lidar_mi.retrieval import threads
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

from .cases import DT, Pair, vortex_pair_images
from .measure import in_turns
from .report import Comparison, Row, row

METHODS = ("variational", "multipass", "cc")
NOISE = 0.02


def compare(
    repeats: int = 5,
    sizes: tuple[tuple[int, int], ...] = ((219, 139), (438, 278)),
    loads: tuple[bool, ...] = (False, True),
) -> Comparison:
    """Wall time of one retrieval."""
    lines = []
    pairs = [vortex_pair_images(NOISE, 1, *size) for size in sizes]
    for busy in loads:
        with _load(busy):
            lines += [_row(pair, method, busy, repeats) for pair in pairs for method in METHODS]
    note = (
        f"Default: {torch.get_num_threads()} threads. Busy: {os.cpu_count()} other processes "
        "at full load."
    )
    return Comparison(
        "Threads of a retrieval", "lidar-mi", "torch's default", tuple(lines), (note,)
    )


def _row(pair: Pair, method: str, busy: bool, repeats: int) -> Row:
    sides = {"ours": threads.SMALL, "torch's": 0}
    found = in_turns({n: _retrieval(pair, method, small) for n, small in sides.items()}, repeats)
    ours, other = ([t.seconds for t in timed] for timed in found.values())
    rows, columns = pair.first.shape
    case = f"{columns} x {rows} px, {'busy' if busy else 'quiet'} machine"
    return row(case, method, "s", ours, other, better="lower")


def _retrieval(pair: Pair, method: str, small: int) -> Callable[[int], None]:
    def run(_turn: int) -> None:
        before, threads.SMALL = threads.SMALL, small
        try:
            retrieve_wind(
                pair.first, pair.second, DT, method, windows=WindowSizes(stride=4), noise=NOISE
            )
        finally:
            threads.SMALL = before

    return run


@contextmanager
def _load(busy: bool) -> Iterator[None]:
    """As many processes as cores that compute all the time."""
    start = multiprocessing.get_context("spawn")
    others = [start.Process(target=_spin, daemon=True) for _ in range(os.cpu_count() or 1)]
    try:
        for process in others if busy else ():
            process.start()
        if busy:
            time.sleep(1.0)
        yield
    finally:
        for process in others if busy else ():
            process.terminate()
            process.join()


def _spin() -> None:
    while True:
        pass
