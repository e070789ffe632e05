"""Timing in turns, in separate processes, and their memory."""

import multiprocessing
import re
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple


class Timed(NamedTuple):
    """The result of a call and its duration."""

    seconds: float
    result: Any


def in_turns(tasks: Mapping[str, Callable[[int], Any]], repeats: int) -> dict[str, list[Timed]]:
    """Call all tasks in turns, so that disturbances of the machine affect all of them alike.

    A task is called with the number of the turn, 0 ... repeats - 1, and before the first turn once
    with ``repeats``, untimed, so that nothing is compiled in the timed calls.
    """
    for task in tasks.values():
        task(repeats)
    found = {name: [] for name in tasks}
    for turn in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            result = task(turn)
            found[name].append(Timed(time.perf_counter() - start, result))
    return found


def fresh_process() -> ProcessPoolExecutor:
    """One new process, with scenes, kernels, plugins and memory of its own.

    Live scenes and media of one process enter each other's kernels, and the peak memory of a
    process never decreases.
    """
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def peak_memory() -> float:
    """Largest resident memory of this process so far, bytes (Linux; NaN elsewhere)."""
    status = Path("/proc/self/status")
    match = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.is_file() else None
    return 1024.0 * int(match[1]) if match else float("nan")
