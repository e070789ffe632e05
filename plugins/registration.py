"""Registration of plugins with Mitsuba, in the variant in force and in every later one.

A Mitsuba class belongs to one variant, and so does a registration. Every plugin module calls
`register` at its end. It can be loaded in three ways: by `lidar_mi.plugins`, which imports all; by
Mitsuba 3.10, which imports the modules named by entry points and reloads them after every change
of variant; and by a user's own import. Registering a plugin again replaces it.
"""

from collections.abc import Callable
from typing import NoReturn

import mitsuba as mi

from .variant_types import Properties

_known: dict[str, tuple[str, Callable[[], type]]] = {}
_following_variants = False


def register(kind: str, name: str, define: Callable[[], type]) -> None:
    """Register one plugin with Mitsuba, now and after every change of variant.

    Parameters
    ----------
    kind : str
        Kind of Mitsuba plugin: emitter, sensor, integrator, phase, texture, volume or bsdf.
    name : str
        Type name in scenes.
    define : callable
        Builds the plugin's class for the variant in force.
    """
    global _following_variants
    _known[name] = kind, define
    if not _following_variants:
        mi.detail.add_variant_callback(lambda _old, _new: register_plugins())
        _following_variants = True
    _register_now(name)


def register_plugins() -> None:
    """Register the plugins of lidar-mi with Mitsuba, in the variant in force and every later one.

    May be called at any time and any number of times, before or after ``mi.set_variant``. In scalar
    variants a scene with one of the plugins is refused, with the reason; volumes are unknown there.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import mitsuba as mi
    >>> lm.register_plugins()
    >>> _ = mi.set_variant("llvm_ad_mono")
    >>> laser = mi.load_dict({"type": "laser"})
    """
    for name in _known:
        _register_now(name)


def _register_now(name: str) -> None:
    variant = mi.variant()
    if not variant:
        return
    kind, define = _known[name]
    if not hasattr(mi, f"register_{kind}"):
        # Mitsuba 3.9 has no function for volumes; any registers what a class is derived from. Its
        # parser takes the kind of a plugin from scalar_rgb, and would refuse the volume ever after.
        if variant.startswith("scalar"):
            return
        kind = "texture"
    # Python plugins handle arrays of rays, which scalar variants do not have.
    make = _refusal(name, variant) if variant.startswith("scalar") else define()
    getattr(mi, f"register_{kind}")(name, make)


def _refusal(name: str, variant: str) -> Callable[[Properties], NoReturn]:
    """Replacement of a plugin in a scalar variant: raises an error of one line."""

    def refuse(_properties: Properties) -> NoReturn:
        raise ValueError(
            f"{name}: the variant {variant} is not allowed, as it has no arrays of rays; expected "
            "llvm_ad_* or cuda_ad_*"
        )

    return refuse
