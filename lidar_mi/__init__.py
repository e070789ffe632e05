"""lidar-mi: virtual lidars that look at wake vortices.

Importing the package picks an LLVM that Dr.Jit can use and makes the Mitsuba plugins known in
every variant set before or after. Import it before ``mitsuba`` or ``drjit`` where several LLVM
versions are installed.
"""

__version__ = "0.1.0"

from lidar_mi.system.llvm import select_llvm as _select_llvm

_select_llvm()

from lidar_mi.plugins import register as _register

_register()
