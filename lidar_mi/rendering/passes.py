"""Rendering in smaller passes where the memory of the device is full."""

import gc
from collections.abc import Callable
from typing import Any, TypeVar

from lidar_mi.errors import InputError, causes

T = TypeVar("T")

LEAST = 1024
"""Samples of a pass: fewer waste the device."""
_SMALLER = 4


def within_memory(integrator: Any, render: Callable[[], T]) -> T:
    """Result of a renderer, repeated in passes of a quarter of the samples if memory is full.

    The integrator keeps the smaller passes, for the images that follow. Images do not depend on
    them but for rounding.

    Raises InputError: memory is full with the smallest passes, too.
    """
    import drjit as dr

    while True:
        try:
            return render()
        except Exception as error:
            # Dr.Jit has no exception of its own for this
            if not any("out of memory" in str(cause).lower() for cause in causes(error)):
                raise
            if integrator.samples_per_pass <= LEAST:
                raise InputError(
                    f"render: {integrator.samples_per_pass} samples at once are not allowed; the "
                    "memory of the device that renders is full, expected fewer beams, gates or "
                    "orders, other programs ended, or device: cpu"
                ) from None
        # outside of the clause, whose traceback holds arrays
        gc.collect()
        dr.flush_malloc_cache()
        integrator.samples_per_pass = max(LEAST, integrator.samples_per_pass // _SMALLER)
