"""Registers the plugins when Mitsuba is imported, without importing it.

``import lidar_mi`` and ``import mitsuba``, in either order, are enough for scenes that name the
plugins. Mitsuba 3.10 and later do the same by entry points, without this module. A CUDA variant
that cannot run raises an error with the reason.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_MITSUBA = "mitsuba"
_CUDA = "mitsuba.cuda_"
NO_CUDA = "no NVIDIA GPU with a driver that is new enough; expected an llvm_ad_* variant"
"""Why a CUDA variant cannot be set."""


def register_plugins_with_mitsuba() -> None:
    """Register the plugins now if Mitsuba is imported, else when it will be."""
    sys.meta_path.insert(0, _Finder())
    if _MITSUBA in sys.modules:
        _register()


class _Finder:
    """Finds Mitsuba and its variants as the finders behind this one do, and adds to it."""

    searching = False

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if self.searching or not (name == _MITSUBA or name.startswith(_CUDA)):
            return None
        self.searching = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self.searching = False
        if spec is None or spec.loader is None:
            return spec
        loader: Any = spec.loader  # methods of this instance alone are replaced
        if name == _MITSUBA:
            loader.exec_module = _with_plugins(loader.exec_module)
        else:
            loader.create_module = _explained(loader.create_module, name)
            loader.exec_module = _explained(loader.exec_module, name)
        return spec


def _with_plugins(execute: Callable[[ModuleType], None]) -> Callable[[ModuleType], None]:
    """The import of Mitsuba, which the plugins follow."""

    def execute_and_register(module: ModuleType) -> None:
        execute(module)
        _register()

    return execute_and_register


def _explained(load: Callable[[Any], Any], name: str) -> Callable[[Any], Any]:
    """The import of a variant, whose error says what this machine lacks.

    It stays an ImportError, by which ``mitsuba.set_variant`` goes on to the next of several names.
    """

    def load_or_explain(argument: Any) -> Any:
        try:
            return load(argument)
        except ImportError as error:
            variant = name.rpartition(".")[2]
            raise ImportError(f"variant: {variant} cannot run here: {NO_CUDA}") from error

    return load_or_explain


def _register() -> None:
    importlib.import_module("lidar_mi.plugins")
