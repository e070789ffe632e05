"""Mitsuba plugins: how light moves, and how a lidar sends and receives it.

One plugin a file. A Mitsuba class belongs to one variant, so every plugin module holds a function
``define()`` that builds its class for the variant in force, and says under which ``NAME`` and
``KIND`` Mitsuba knows it; the module's docstring is the plugin's reference page.

Importing this package registers all plugins, see `registration`.
"""

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
from .registration import register_plugins

__all__ = ["PLUGINS", "register_plugins"]

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
