"""The memory that a process of this machine may have."""

import os
import subprocess
from pathlib import Path

GIB = 1 << 30
UNKNOWN_GPU = 2 * GIB
"""Free bytes assumed for a GPU where they are unknown."""


def machine_memory() -> int:
    """Bytes of this machine, or of the container that this process lives in."""
    return min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_container_limits()])


def available_memory() -> int:
    """Bytes that are not in use, as the kernel estimates it; at most `machine_memory`."""
    meminfo = Path("/proc/meminfo")
    lines = meminfo.read_text().splitlines() if meminfo.is_file() else []
    free = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable")]
    return min([machine_memory(), *free])


def gpu_memory() -> int:
    """Bytes that are free on the GPU that renders: by the driver's tool, or else by torch.

    If neither states it, `UNKNOWN_GPU`.
    """
    device = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0] or "0"
    query = ["nvidia-smi", "-i", device, "--query-gpu=memory.free", "--format=csv,noheader,nounits"]
    try:
        text = subprocess.run(query, check=True, capture_output=True, text=True, timeout=20).stdout
        return int(text.split()[0]) << 20
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        import torch

        return torch.cuda.mem_get_info()[0] if torch.cuda.is_available() else UNKNOWN_GPU


def _container_limits() -> list[int]:
    limits = []
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        limit = Path("/sys/fs/cgroup", file)
        if limit.is_file() and (text := limit.read_text().strip()).isdigit():
            limits.append(int(text))
    return limits
