"""What a caller may give an integrator: a report of its passes, and a store for them."""

from collections.abc import Callable, Mapping
from typing import Protocol, TypeAlias

import numpy as np

Progress: TypeAlias = Callable[[int, int], object]
"""Called after every pass with the number of samples done, and of all."""


class Batches(Protocol):
    """A store of finished passes, from which an interrupted rendering goes on."""

    def stored(self) -> tuple[int, Mapping[str, np.ndarray]]:
        """Number of passes that an earlier run has stored, and their arrays by name."""
        ...

    def store(self, passes: int, arrays: Callable[[], dict[str, np.ndarray]]) -> None:
        """Store the arrays of so many passes; they are asked for only if they are stored."""
        ...


def stored_passes(
    batches: Batches | None, samples_per_pass: int, values: int | None = None
) -> tuple[int, Mapping[str, np.ndarray]]:
    """Number of passes that need not be traced again, and their arrays.

    None if stored passes have another size, as of another machine's memory, and end at other
    samples; none if their image has another number of ``values``, as of other quantities.
    """
    if batches is not None:
        passes, arrays = batches.stored()
        same = values is None or np.size(arrays.get("image", ())) == values
        if passes and same and int(arrays.get("samples_per_pass", -1)) == samples_per_pass:
            return passes, arrays
    return 0, {}
