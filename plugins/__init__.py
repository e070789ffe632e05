"""Mitsuba plugins: light transport, and emission and reception by a lidar.

One plugin per file. A Mitsuba class belongs to one variant, so every plugin module has a function
``define()`` that builds its class for the variant in force. ``NAME`` and ``KIND`` are those of its
registration; the module's docstring is the plugin's reference page.

Importing this package registers all plugins, see `registration`.
"""

from . import (
    ccd,
    etalon,
    fringes,
    gated_volpath,
    laser,
    moving_volume,
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
    moving_volume,
    mueller,
    rayleigh_polarized,
    spectral_line,
    plane_waves,
    etalon,
    ccd,
    fringes,
)
