"""The machine's memory, as far as a process may have it."""

import os
from pathlib import Path

GIB = 1 << 30


def machine_memory() -> int:
    """Bytes of this machine, or of the container that this process lives in."""
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_container_limits()])


def available_memory() -> int:
    """Bytes that are not in use, as the kernel estimates it; at most `machine_memory`."""
    meminfo = Path("/proc/meminfo")
    lines = meminfo.read_text().splitlines() if meminfo.is_file() else []
    free = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable")]
    return min([machine_memory(), *free])


def _container_limits() -> list[int]:
    limits = []
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        limit = Path("/sys/fs/cgroup", file)
        if limit.is_file() and (text := limit.read_text().strip()).isdigit():
            limits.append(int(text))
    return limits
