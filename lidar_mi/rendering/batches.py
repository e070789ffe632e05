"""Samples of an image that takes long, kept while it is rendered."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

INTERVAL = 30.0
"""Seconds between two times that samples are kept."""

Arrays = dict[str, np.ndarray]


class Batches:
    """What the passes of one image have given so far.

    The integrators of the plugins ask for what is `kept` at their start, and offer what they have
    after every pass.

    Parameters
    ----------
    load : callable
        Returns what an earlier run kept of the image, or None.
    save : callable
        Takes what is to be kept.

    Attributes
    ----------
    seconds : float
        What earlier runs took for the passes that are kept.
    """

    def __init__(self, load: Callable[[], Arrays | None], save: Callable[[Arrays], None]):
        self._load, self._save = load, save
        self.seconds = 0.0
        self._start = time.monotonic()
        self._next = self._start + INTERVAL

    def kept(self) -> tuple[int, Arrays]:
        """How many passes are kept, and what they have given."""
        arrays = self._load()
        if arrays is None:
            return 0, {}
        self.seconds = float(arrays.pop("seconds"))
        return int(arrays.pop("passes")), arrays

    def keep(self, passes: int, arrays: Callable[[], dict[str, Any]]) -> None:
        """Keep what so many passes have given, if it is time to."""
        start = time.monotonic()
        if start < self._next:
            return
        seconds = self.seconds + start - self._start
        self._save({"passes": np.array(passes), "seconds": np.array(seconds)} | arrays())
        end = time.monotonic()
        # of large images on slow disks, a tenth of the time is enough
        self._next = end + max(INTERVAL, 10 * (end - start))
