"""lidar-mi: virtual lidars that look at wake vortices.

``import lidar_mi as lm`` is fast: it chooses an LLVM that Dr.Jit can use and loads neither Mitsuba
nor torch. The public names, listed in ``__init__.pyi``, are loaded on first use. The Mitsuba
plugins become known as soon as Mitsuba is imported. Import the package before ``mitsuba`` or
``drjit`` where several LLVM versions are installed.
"""

import lazy_loader

from lidar_mi.system.llvm import select_llvm
from lidar_mi.system.mitsuba_import import register_plugins_with_mitsuba

__version__ = "1.0.0rc1"

select_llvm()
register_plugins_with_mitsuba()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
del lazy_loader, select_llvm, register_plugins_with_mitsuba
