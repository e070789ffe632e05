"""Images that are rendered one after the other, and storage of the samples of an unfinished one."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

INTERVAL = 30.0
"""Seconds between two times that samples are stored."""

Arrays = dict[str, np.ndarray]


class Batches:
    """The results of an image's finished passes.

    The integrators of the plugins read the `stored` passes at their start, and call `store` after
    every pass.

    load: returns the arrays stored by an earlier run, or None.
    save: stores arrays.
    seconds: time spent by earlier runs on the stored passes.
    """

    def __init__(self, load: Callable[[], Arrays | None], save: Callable[[Arrays], None]) -> None:
        self._load, self._save = load, save
        self.seconds = 0.0
        self._start = time.monotonic()
        self._next = self._start + INTERVAL

    def stored(self) -> tuple[int, Arrays]:
        """Number of stored passes, and their results."""
        arrays = self._load()
        if arrays is None:
            return 0, {}
        self.seconds = float(arrays.pop("seconds"))
        return int(arrays.pop("passes")), arrays

    def store(self, passes: int, arrays: Callable[[], dict[str, Any]]) -> None:
        """Store the results of so many passes, if the interval is over."""
        start = time.monotonic()
        if start < self._next:
            return
        seconds = self.seconds + start - self._start
        self._save({"passes": np.array(passes), "seconds": np.array(seconds)} | arrays())
        end = time.monotonic()
        # for large images on slow disks, at most 10 % of the time is spent on storage
        self._next = end + max(INTERVAL, 10 * (end - start))


@dataclass(frozen=True)
class Series:
    """Which images of a series are rendered, and who follows it; all by their number.

    wanted: default: all.
    progress: called with (image, samples done, samples in all).
    batches: gives the store of an image's samples while it is rendered.
    """

    wanted: Sequence[int] | None = None
    progress: Callable[[int, int, int], None] | None = None
    batches: Callable[[int], Batches] | None = None


ALL_IMAGES = Series()
"""Of a series that nobody follows."""
