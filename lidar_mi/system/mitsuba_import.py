"""Plugins that are there as soon as Mitsuba is, without loading it for those who do not need it.

``import lidar_mi`` and ``import mitsuba``, in either order, are enough for scenes that name the
plugins. Mitsuba 3.10 and later do the same by entry points, without this module.
"""

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec

_MITSUBA = "mitsuba"


def register_plugins_with_mitsuba() -> None:
    """Register the plugins now if Mitsuba is imported, else when it will be."""
    if _MITSUBA in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _Finder())


class _Finder:
    """Finds Mitsuba as the finders behind this one do, and has the plugins follow its import."""

    searching = False

    def find_spec(self, name, path=None, target=None) -> ModuleSpec | None:
        if name != _MITSUBA or self.searching:
            return None
        self.searching = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self.searching = False
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module):
            execute(module)
            _register()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def _register() -> None:
    importlib.import_module("lidar_mi.plugins")
