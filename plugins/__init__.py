"""Mitsuba plugins: how light moves, and how a lidar sends and receives it.

One plugin a file. A Mitsuba class belongs to one variant, so every plugin module holds a function
``define()`` that builds its class for the variant in force, and says under which ``NAME`` and
``KIND`` Mitsuba knows it; the module's docstring is the plugin's reference page.

`register` may be called at any time and any number of times. Once called, the plugins follow every
later ``mi.set_variant``.
"""

import mitsuba as mi

from . import (
    ccd,
    etalon,
    fringes,
    gated_volpath,
    laser,
    mueller,
    plane_waves,
    rayleigh_polarized,
    scanning_lidar,
    spectral_line,
)

PLUGINS = (
    laser,
    scanning_lidar,
    gated_volpath,
    mueller,
    rayleigh_polarized,
    spectral_line,
    plane_waves,
    etalon,
    ccd,
    fringes,
)

_following_variants = False


def register() -> None:
    """Make the plugins known to Mitsuba in the variant in force and in every later one."""
    global _following_variants
    if not _following_variants:
        mi.detail.add_variant_callback(lambda _old, new: _register_in(new))
        _following_variants = True
    if mi.variant():
        _register_in(mi.variant())


def _register_in(variant: str | None) -> None:
    # Python plugins handle arrays of photons: the scalar variants have none.
    if not variant or variant.startswith("scalar"):
        return
    for plugin in PLUGINS:
        getattr(mi, f"register_{plugin.KIND}")(plugin.NAME, plugin.define())
