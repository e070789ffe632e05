"""Plain arrays under names, as NumPy's zip file."""

import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically


def write_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays, numbers and texts, whole or not at all; errors as of `write_atomically`."""
    buffer = BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_atomically(path, buffer.getbuffer())


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The contents of a file by `write_arrays`, exactly; checksums within the file are checked.

    Raises InputError: a file that cannot be read or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, LookupError, zipfile.BadZipFile, AttributeError):
        raise InputError(f"{path}: not a readable file of arrays; expected an .npz file") from None
