"""Number of threads for an image: one, unless it is large.

A step of a retrieval takes some 0.1 ms on an image of the paper's size. The synchronisation of
threads then takes longer than their work, the more so on a machine with other load.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

SMALL = 1 << 18
"""Pixels up to which one thread is as fast as two on a quiet machine (`benchmarks threads`)."""


@contextmanager
def threads_for(pixels: int) -> Iterator[None]:
    """Work with one thread on so few pixels, with torch's own number on more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1 if pixels <= SMALL else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
