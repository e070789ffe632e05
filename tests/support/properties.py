"""Properties that hold for any seed: a name, and a check of one seed that says what broke.

Short tests try a few seeds, ``make fuzz`` as many as there is time for, and prints those that fail.
"""

from collections.abc import Callable
from functools import cache

from tests.support import image_files


@cache
def _variant():
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    mi.set_log_level(mi.LogLevel.Error)


def extinction_fields(seed: int) -> str | None:
    """A random field's signal agrees with the lidar equation by quadrature."""
    from validation.extinction_fields import check

    _variant()
    return check(seed)


PROPERTIES: dict[str, Callable[[int], str | None]] = {
    "extinction_fields": extinction_fields,
    "image_files": image_files.check,
}
