"""Folders of results: created, identified, locked by one process at a time."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import TEMPORARY, sync_folder

_LOCK = ".lock"


def is_free(folder: str | Path) -> bool:
    """Whether a folder is missing, or empty except for files left by a killed process."""
    folder = Path(folder)
    if not folder.exists():
        return True
    return folder.is_dir() and all(
        path.name == _LOCK or path.match(TEMPORARY) for path in folder.iterdir()
    )


def make_folder(folder: str | Path) -> None:
    """Create a folder and its parents, where they are missing."""
    folder = Path(folder)
    try:
        if not folder.is_dir():
            # another process may be making it, too
            folder.mkdir(parents=True, exist_ok=True)
            sync_folder(folder.parent)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made ({error.strerror}); expected a folder to write in"
        ) from None


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Lock a folder within the context.

    The operating system holds the lock (``flock`` on a file in the folder) and releases it when the
    process ends in any way. The file is removed at the end; one left by a killed process has no
    effect.

    Raises InputError: another process or thread has locked the folder; or no file can be locked in
    it.
    """
    path = Path(folder) / _LOCK
    try:
        descriptor = _take(path)
    except BlockingIOError:
        raise InputError(
            f"{folder}: is in use by another run; expected another folder (-o DIR), or to start "
            "when that run has ended"
        ) from None
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be locked ({error.strerror}); expected a folder to write in"
        ) from None
    try:
        yield
    finally:
        # with the lock held, so that no other process can lock a file of this name
        with suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _take(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # its last holder may have removed the file between the two calls
            if path.exists() and os.path.samestat(path.stat(), os.fstat(descriptor)):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
