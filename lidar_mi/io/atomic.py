"""Atomic and durable writing of files."""

import errno
import os
import platform
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

from lidar_mi.errors import InputError

# a process killed while writing leaves only such a file
TEMPORARY = ".lidar-mi.*.part"

_numbers = count()


def write_atomically(
    path: str | Path, content: bytes | memoryview, first: Callable[[], object] | None = None
) -> None:
    """Write a file under a temporary name beside the final one, sync it to the disk, rename it.

    Until the file is renamed, an error or a kill leaves the former file unchanged. When this
    function returns, the file survives a loss of power. Temporary files of killed processes in the
    same folder are removed.

    content: of the whole file.
    first: called when the content is on the disk, before the file is renamed.

    Raises InputError: the file cannot be written there, or the path is not that of an ordinary
    file.
    """
    path = Path(path)
    try:
        if not path.parent.is_dir():
            raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is no ordinary file; expected a file or a new name")
        _remove_leftovers(path.parent)
        temporary = path.with_name(f"{_host_prefix()}{os.getpid()}.{next(_numbers)}.part")
        try:
            _write_synced(temporary, content)
            if first:
                first()
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); expected a folder to write in, with "
            "room left"
        ) from error


def sync_folder(folder: str | Path) -> None:
    """Sync a folder: without it, a loss of power may undo the renaming of a file."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # file systems that cannot sync a folder
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def _write_synced(path: Path, content: bytes | memoryview) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _host_prefix() -> str:
    return f".lidar-mi.{platform.node()}."


def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files of processes of this machine that have ended."""
    for path in folder.glob(TEMPORARY):
        process = path.name.removeprefix(_host_prefix()).split(".")[0]
        if path.name.startswith(_host_prefix()) and process.isdigit() and not _lives(int(process)):
            path.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # of another user; a number that no process can have
        return True
    return True
