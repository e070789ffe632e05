"""Registering plugins with Mitsuba, in the variant in force and in every later one.

A Mitsuba class belongs to one variant, and so does a registration. Every plugin module calls
`register` at its end. This serves three ways of loading it: `lidar_mi.plugins`, which imports all;
Mitsuba 3.10, which imports the modules that entry points name and reloads them after every change
of variant; and a user's own import. Registering a plugin again replaces it.
"""

from collections.abc import Callable

import mitsuba as mi

_known: dict[str, tuple[str, Callable[[], type]]] = {}
_following_variants = False


def register(kind: str, name: str, define: Callable[[], type]) -> None:
    """Make one plugin known to Mitsuba, now and after every change of variant.

    Parameters
    ----------
    kind : str
        Of Mitsuba's: emitter, sensor, integrator, phase, texture or bsdf.
    name : str
        By which scenes call it.
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
    """Make the plugins of lidar-mi known to Mitsuba, in the variant in force and every later one.

    May be called at any time and any number of times, before or after ``mi.set_variant``. Scalar
    variants do not know the plugins.

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
    # Python plugins handle arrays of rays: the scalar variants have none.
    variant = mi.variant()
    if variant and not variant.startswith("scalar"):
        kind, define = _known[name]
        getattr(mi, f"register_{kind}")(name, define())
