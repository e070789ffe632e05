"""Where a command may write: not over what it reads, nor unasked over what others made."""

import os
import re
from collections.abc import Iterable
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from lidar_mi.errors import InputError
from lidar_mi.io.exr import read_header
from lidar_mi.io.netcdf import open_netcdf

_OURS = "lidar-mi "


def check_target(
    path: str | Path, inputs: Iterable[str | Path] = (), *, overwrite: bool = False
) -> None:
    """Refuse a place that nothing may be written to, before any work is done for it.

    Parameters
    ----------
    path : path
    inputs : iterable of path
        What is read: never replaced, under any name.
    overwrite : bool
        Replace a file that is no result of lidar-mi.

    Raises
    ------
    InputError
        There is no such folder; an input, or something else than a file, is in the place; or a file
        of someone else, and ``overwrite`` is not set.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    if not path.exists():
        return
    if not path.is_file():
        raise InputError(f"{path}: is no ordinary file; expected a file or a new name (-o FILE)")
    if any(Path(one).exists() and os.path.samefile(path, one) for one in inputs):
        raise InputError(f"{path}: is an input; expected another file (-o FILE)")
    if not overwrite and not software(path).startswith(_OURS):
        raise InputError(
            f"{path}: is no result of lidar-mi; expected another file (-o FILE), or --overwrite to "
            "replace it"
        )


def software(path: str | Path) -> str:
    """What a file says it was written by: EXR, NetCDF, PNG or text; empty: nothing."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            start = file.read(4096)
        if start.startswith(b"v/1\x01"):
            return str(read_header(path).get("software", ""))
        if start.startswith(b"\x89HDF"):
            with open_netcdf(path) as data:
                return str(data.attrs.get("software", ""))
        if start.startswith(b"\x89PNG"):
            with Image.open(path) as image:
                return str(image.info.get("Software", ""))
        line = re.search(rb"(?m)^# software: (.*)$", start)
        return line[1].decode() if line else ""
    except (InputError, OSError, UnidentifiedImageError, UnicodeDecodeError):
        return ""
