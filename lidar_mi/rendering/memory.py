"""Memory used by images of the backscatter lidar, and number of samples within the limit."""

from lidar_mi.errors import InputError
from lidar_mi.system.memory import GIB, machine_memory

PROGRAM = 0.8e9
"""Bytes of Python, Mitsuba, torch and their kernels, and of drawing; measured: 0.84 GB."""
PER_SAMPLE = 100
"""Bytes of a sample while it is traced, with the sums of its gate; measured: 65."""
PER_PIXEL = 500
"""Bytes of a pixel of the fringe camera: sixty images in double precision."""
FRACTION = 0.25
"""Of the memory, for samples that are traced at once."""


def ceiling(memory: float | None) -> float:
    """Limit of a run's memory, bytes: as given, or half of the machine's memory."""
    return machine_memory() / 2 if memory is None else memory


def samples_at_once(samples_per_pass: int, memory: float | None) -> int:
    """Samples of a pass, as given or as many as fit into memory; images do not depend on it."""
    return max(1024, min(samples_per_pass, int(FRACTION * ceiling(memory) / PER_SAMPLE)))


def image_bytes(beams: int, gates: int, quantities: int) -> float:
    """Bytes of an image while it is rendered, copied once, and written.

    Parameters
    ----------
    quantities : int
        Of every beam and gate: Stokes components, errors, orders.
    """
    return 4.0 * beams * gates * quantities * 4


def check_memory(
    needed: float, memory: float | None, what: str, remedy: str, key: str = "render.memory"
) -> None:
    """Refuse to exceed the limit of the memory.

    Raises
    ------
    InputError
        The memory needed is above the limit.
    """
    allowed = ceiling(memory)
    if needed > allowed:
        whose = key if memory is not None else "half of this machine's"
        raise InputError(
            f"{what} is not allowed; it would take {needed / GIB:.3g} GiB of memory, expected at "
            f"most {allowed / GIB:.3g} GiB ({whose}): {remedy}"
        )
