"""Limits of the memory for a file: its declared size against its real size."""

from pathlib import Path

from lidar_mi.errors import InputError

ALWAYS = 256 << 20
"""Bytes that any file may unpack to."""
PER_BYTE = 200
"""Bytes that every byte of a file may unpack to: measured images compress by less than ten."""


def fits(path: str | Path, size: int) -> bool:
    """Whether a file may unpack to so many bytes."""
    return size <= max(ALWAYS, PER_BYTE * Path(path).stat().st_size)


def check_size(path: str | Path, size: int, what: str = "it") -> None:
    """Refuse a declared size out of proportion to the file, before it is read.

    A few hundred bytes can declare an array of gigabytes, all of it zero or missing.

    size: bytes, unpacked.
    what: part of the file that has this size, for the message.

    Raises InputError: more than 256 MiB and more than 200 times the file.
    """
    if not fits(path, size):
        stored = Path(path).stat().st_size
        raise InputError(
            f"{path}: {what} declares {size:.3g} bytes in a file of {stored}; expected at most "
            f"{ALWAYS >> 20} MiB, or {PER_BYTE} times the file"
        )
