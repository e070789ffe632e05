"""Device of a retrieval, and smaller tiles where its memory is full."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import TypeVar

import torch

from lidar_mi.errors import InputError

T = TypeVar("T")

AUTO = "auto"
"""Name of a device: CUDA's if there is one, else the processor."""
_DIVISORS = (1, 16, 256)
_DIVISOR: ContextVar[int] = ContextVar("divisor", default=1)


def device_of(name: str | torch.device) -> torch.device:
    """The device of a name, of which `AUTO` is one.

    Raises RuntimeError: no name of a device.
    """
    if name == AUTO:
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def divisor() -> int:
    """By how much tiles of windows are smaller than usual."""
    return _DIVISOR.get()


def within_memory(compute: Callable[[], T]) -> T:
    """Result of a function, repeated with smaller tiles where the device's memory is full.

    Raises InputError: the memory is full with the smallest tiles, too.
    """
    reason = ""
    for number in _DIVISORS:
        before = _DIVISOR.set(number)
        try:
            return compute()
        except torch.OutOfMemoryError as error:
            # without its traceback, which holds tensors
            reason = str(error).splitlines()[0]
        finally:
            _DIVISOR.reset(before)
        torch.cuda.empty_cache()
    raise InputError(
        f"device: its memory is too small for this retrieval ({reason}); expected a smaller image, "
        "a larger stride or the device cpu"
    )
