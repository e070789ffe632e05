"""Number of threads for an image: one, unless it is large.

A step of a retrieval takes some 0.1 ms on an image of the paper's size. The synchronisation of
threads then takes longer than their work, the more so on a machine with other load. Parts of a
large image that do not depend on each other are worked on by one thread each (`mapped`), and so are
small images (`in_turn`): threads that wait for nothing but the last part lose nothing on a busy
machine.
"""

from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import TypeVar

import scipy.linalg  # noqa: F401 its threads are limited, too
import torch
from threadpoolctl import ThreadpoolController

SMALL = 1 << 18
"""Pixels up to which one thread is as fast as two on a quiet machine."""

_Part = TypeVar("_Part")
_Result = TypeVar("_Result")
_AVAILABLE: ContextVar[int | None] = ContextVar("available", default=None)


@contextmanager
def threads_for(pixels: int) -> Iterator[None]:
    """Work with one thread on so few pixels, with torch's own number on more.

    So does the linear algebra of numpy and scipy.
    """
    before = torch.get_num_threads()
    available = _AVAILABLE.set(before)
    torch.set_num_threads(1 if pixels <= SMALL else before)
    try:
        with _libraries().limit(limits=1 if pixels <= SMALL else None, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
        _AVAILABLE.reset(available)


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """Those that are loaded; to look for them takes a millisecond."""
    return ThreadpoolController()


def mapped(function: Callable[[_Part], _Result], parts: Iterable[_Part]) -> list[_Result]:
    """The function of every part, each computed by one of as many threads as torch was given."""
    return list(in_turn(function, parts))


def in_turn(
    function: Callable[[_Part], _Result], parts: Iterable[_Part]
) -> Generator[_Result, None, None]:
    """Results of the parts in their order, each as soon as it is computed."""
    parts = list(parts)
    before = torch.get_num_threads()
    number = min(len(parts), _AVAILABLE.get() or before)
    if number < 2:
        yield from map(function, parts)
        return
    # inference mode is local to a thread
    in_mode = torch.inference_mode(torch.is_inference_mode_enabled())(function)
    try:
        with ThreadPoolExecutor(number, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield from pool.map(in_mode, parts)
    finally:
        torch.set_num_threads(before)
