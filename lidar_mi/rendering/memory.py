"""Memory used by images of the backscatter lidar, and number of samples within the limit."""

from lidar_mi.errors import InputError
from lidar_mi.rendering.passes import LEAST
from lidar_mi.rendering.settings import FringeSettings, RenderSettings
from lidar_mi.system.memory import GIB, gpu_memory, machine_memory

PROGRAM = 0.8e9
"""Bytes of Python, Mitsuba, torch and their kernels, and of drawing; measured: 0.84 GB."""
PER_SAMPLE = 100
"""Bytes of a sample while it is traced, with the sums of its gate; measured: 65."""
PER_PIXEL = 500
"""Bytes of a pixel of the fringe camera: sixty images in double precision."""
FRACTION = 0.25
"""Of the memory, for samples that are traced at once."""
MOST_AT_ONCE = {"llvm": 1 << 22, "cuda": 1 << 28}
"""Samples of a pass by the device that renders, unless their number is given. On two to sixteen
cores more of them are no faster. A GPU is the busier the more there are; their indices have 32
bits."""


def ceiling(memory: float | None) -> float:
    """Limit of a run's memory, bytes: as given, or half of the machine's memory."""
    return machine_memory() / 2 if memory is None else memory


def samples_at_once(samples_per_pass: int | None, memory: float | None, variant: str) -> int:
    """Samples of a pass, as given or as many as fit into the memory of the device that renders.

    Images do not depend on it but for rounding.

    samples_per_pass: default: `MOST_AT_ONCE`.
    memory: of the machine, that a run may take, bytes; of a GPU, what is free counts.
    variant: of Mitsuba.
    """
    backend = backend_of(variant)
    most = MOST_AT_ONCE[backend] if samples_per_pass is None else samples_per_pass
    room = gpu_memory() if backend == "cuda" else ceiling(memory)
    return min(most, max(LEAST, int(FRACTION * room / PER_SAMPLE)))


def host_bytes(samples: float, settings: RenderSettings | FringeSettings) -> float:
    """Bytes of the machine's memory for that many samples of an image: none where a GPU renders."""
    if backend_of(settings.variant) == "cuda":
        return 0.0
    at_once = samples_at_once(settings.given_per_pass, settings.memory, settings.variant)
    return PER_SAMPLE * min(samples, at_once)


def backend_of(variant: str) -> str:
    """Either llvm or cuda."""
    return variant.partition("_")[0]


def image_bytes(beams: int, gates: int, quantities: int) -> float:
    """Bytes of an image while it is rendered, copied once, and written.

    quantities: of every beam and gate: Stokes components, errors, orders.
    """
    return 4.0 * beams * gates * quantities * 4


def check_memory(
    needed: float, memory: float | None, what: str, remedy: str, key: str = "render.memory"
) -> None:
    """Refuse to exceed the limit of the memory.

    Raises InputError: the memory needed is above the limit.
    """
    allowed = ceiling(memory)
    if needed > allowed:
        whose = key if memory is not None else "half of this machine's"
        raise InputError(
            f"{what} is not allowed; it would take {needed / GIB:.3g} GiB of memory, expected at "
            f"most {allowed / GIB:.3g} GiB ({whose}): {remedy}"
        )
