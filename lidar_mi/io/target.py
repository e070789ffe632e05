"""Checks of output files: no input is overwritten, nor, without a flag, a foreign file."""

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from lidar_mi.errors import InputError
from lidar_mi.io.exr import read_header
from lidar_mi.io.netcdf import open_netcdf

_OURS = "lidar-mi "


def check_target(
    path: str | Path,
    inputs: Iterable[str | Path] = (),
    *,
    overwrite: bool = False,
    suffixes: Sequence[str] = (),
) -> None:
    """Refuse an output path that must not be written, before any work is done.

    inputs: input files, which are never replaced, under any name.
    overwrite: replace a file that does not say that lidar-mi wrote it, as tables (.csv) do not.
    suffixes: of the formats that the command writes; none: whatever the name, the format is one.

    Raises InputError: there is no such folder; the path is that of an input or of no ordinary file;
    or it is a foreign file, and ``overwrite`` is not set; or no format of the command has its
    suffix.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    if not path.exists():
        _check_suffix(path, suffixes)
        return
    if not path.is_file():
        raise InputError(f"{path}: is no ordinary file; expected a file or a new name (-o FILE)")
    if any(Path(source).exists() and os.path.samefile(path, source) for source in inputs):
        raise InputError(f"{path}: is an input; expected another file (-o FILE)")
    if not overwrite and not software(path).startswith(_OURS):
        raise InputError(
            f"{path}: exists, and does not say that lidar-mi wrote it (tables do not); expected "
            "--overwrite to replace it, or another file (-o FILE)"
        )
    _check_suffix(path, suffixes)


def _check_suffix(path: Path, suffixes: Sequence[str]) -> None:
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(
            f"{path}: {path.suffix or 'no suffix'} is not allowed; expected "
            f"{', '.join(suffixes[:-1])}{' or ' if suffixes[1:] else ''}{suffixes[-1]}"
        )


def software(path: str | Path) -> str:
    """The program stated in a file as its writer: EXR, NetCDF, PNG or text; empty: none."""
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
