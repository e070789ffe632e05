"""Names of files for libraries that take text only, where the system allows any bytes."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def library_name(path: str | Path) -> Iterator[str]:
    """A name under which a library opens a file, within the context.

    The absolute name of the file, as libraries interpret a leading ``~`` or ``-``; if it is not
    UTF-8, that of an open descriptor.

    Raises OSError: a file whose name is not UTF-8 cannot be opened.
    """
    name = os.path.abspath(path)
    if is_text(name):
        yield name
        return
    descriptor = os.open(name, os.O_RDONLY)
    try:
        yield f"/dev/fd/{descriptor}"
    finally:
        os.close(descriptor)


def is_text(name: str | Path) -> bool:
    """Whether a file's name is UTF-8."""
    return os.fsencode(name).decode("utf-8", "replace").encode() == os.fsencode(name)
