"""Files that are never half written."""

import os
from collections.abc import Callable
from pathlib import Path


def write_atomically(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` make a file under a temporary name beside the final one, then rename it.

    An error leaves the file that was there before as it was.

    Parameters
    ----------
    path : str or Path
    write : callable
        Called with the temporary path, whose suffix is that of ``path``.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
