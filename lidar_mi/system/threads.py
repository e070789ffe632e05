"""Threads of this process's numerical libraries."""


def use_threads(count: int) -> None:
    """Let Dr.Jit and torch work with so many threads each.

    Both are loaded by this. Processes that share a machine take one each.
    """
    import drjit
    import torch

    drjit.set_thread_count(count)
    torch.set_num_threads(count)
