"""Text files."""

from pathlib import Path

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically


def read_text(path: str | Path, expected: str) -> str:
    """Text of a file.

    Parameters
    ----------
    path : str or Path
    expected : str
        What kind of file was asked for, for the message: "an experiment file".

    Raises
    ------
    InputError
        A file that cannot be read or is not text.
    """
    try:
        return Path(path).read_text()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected {expected}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {expected}") from None


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_atomically(path, lambda part: part.write_text(text))
