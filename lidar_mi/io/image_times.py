"""Times between images, from the headers of a run's EXR files."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from lidar_mi.errors import InputError
from lidar_mi.io.exr import read_header

_OF_A_RUN = ("dt", "telescope_position", "platform_speed")
_TOLERANCE = 1e-3  # relative, of the distance flown


def steps_of(paths: Sequence[str | Path]) -> list[float] | None:
    """Time from each image to the next, s, negative where the later comes first.

    From the scans' reference times. Without them: from the time between the images of a run, whose
    order follows from the telescope's position, unless the gates followed the air.

    Returns
    -------
    list of float, or None
        None: at least one file does not say.
    """
    headers = [_header(path) for path in paths]
    if all(_is_number(header.get("reference_time")) for header in headers):
        times = [float(header["reference_time"]) for header in headers]
        return [_rounded(later - earlier) for earlier, later in pairwise(times)]
    if not all(_is_number(header.get(name)) for header in headers for name in _OF_A_RUN):
        return None
    return [_step(*pair) for pair in pairwise(headers)]


def _step(earlier: dict[str, Any], later: dict[str, Any]) -> float:
    """The time between two images of a run; negative if the telescope moves backwards."""
    dt = _rounded(earlier["dt"])
    path = later["telescope_position"] - earlier["telescope_position"]
    backwards = -earlier["platform_speed"] * dt
    return -dt if path and abs(path - backwards) < _TOLERANCE * abs(backwards) else dt


def _rounded(seconds: float) -> float:
    return float(f"{seconds:.6g}")  # headers hold float32


def _header(path: str | Path) -> dict[str, Any]:
    try:
        return read_header(path)
    except InputError:  # an image of another kind
        return {}


def _is_number(value: object) -> bool:
    return isinstance(value, float | int)
