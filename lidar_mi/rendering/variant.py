"""Setting Mitsuba's variant, with a clear message if it cannot be set."""

import mitsuba as mi

from lidar_mi.errors import InputError
from lidar_mi.rendering.settings import VARIANTS
from lidar_mi.system.llvm import require_llvm


def use_variant(name: str) -> None:
    """Set the Mitsuba variant ``name``.

    Raises
    ------
    InputError
        Not one of `VARIANTS`, no suitable LLVM, or no CUDA device.
    """
    if name not in VARIANTS:
        raise InputError(f"variant: {name!r} is not allowed; expected one of {', '.join(VARIANTS)}")
    if name.startswith("llvm"):
        require_llvm()
    try:
        mi.set_variant(name)
    except ImportError as error:
        if name.startswith("cuda"):
            reason = "no NVIDIA GPU with a driver that is new enough; expected an llvm_ad_* variant"
        else:
            reason = _first_line(error)
        raise InputError(f"variant: {name} cannot run here: {reason}") from None
    # Mitsuba's hint that a monochrome film is monochrome is of no use to anyone here
    mi.set_log_level(mi.LogLevel.Error)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]
