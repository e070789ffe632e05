"""Measuring in turns, in processes of their own, and the memory they took."""

import multiprocessing
import re
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple


class Timed(NamedTuple):
    """What a call returned and how long it took."""

    seconds: float
    result: Any


def in_turns(tasks: Mapping[str, Callable[[int], Any]], repeats: int) -> dict[str, list[Timed]]:
    """Call all tasks one after the other, again and again: a slow moment hits all alike.

    A task is called with the number of the turn, 0 ... repeats - 1, and before the first turn once
    with ``repeats``, untimed, so that nothing is compiled while the clock runs.
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
    """One new process that shares nothing with this one: scenes, kernels, plugins, memory.

    Live scenes and media of one process take part in each other's kernels, and the memory of a
    process is never given back to measure again.
    """
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def peak_memory() -> float:
    """Largest resident memory of this process so far, bytes (Linux; NaN elsewhere)."""
    status = Path("/proc/self/status")
    match = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.is_file() else None
    return 1024.0 * int(match[1]) if match else float("nan")
