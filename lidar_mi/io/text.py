"""Text files."""

import codecs
import re
import shlex
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically

LONGEST = 64 << 20
"""Most bytes of a text file."""


def read_text(path: str | Path, expected: str, longest: int = LONGEST) -> str:
    """Text of a file, UTF-8, without the mark that some editors set before it.

    expected: kind of file expected, for the message: "an experiment file".
    longest: bytes; longer files are not read, nor devices and pipes, which have no end.

    Raises InputError: a file that cannot be read, is too long or is not text.
    """
    path = Path(path)
    try:
        status = path.stat()
        if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
            raise InputError(f"{path}: a device or a pipe; expected {expected}")
        if status.st_size > longest:
            raise InputError(
                f"{path}: {status.st_size} bytes are not allowed; expected {expected} of at most "
                f"{longest} bytes"
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected {expected}") from None
    try:
        # line ends of any system
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        encoding, line = _encoding(content), content.count(b"\n", 0, error.start) + 1
    if encoding is None:
        raise InputError(f"{path}: not a text file; expected {expected}") from None
    command = f"iconv -f {encoding} -t UTF-8 {shlex.quote(str(path))}"
    raise InputError(
        f"{path}: line {line} is not UTF-8; expected {expected} in UTF-8: {command}"
    ) from None


def _encoding(content: bytes) -> str | None:
    """How text that is not UTF-8 may be encoded; None: it is no text."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with suppress(UnicodeDecodeError):
            return "UTF-16" if "\n" in content.decode("utf-16") else None
    # control characters other than tabs, ends of lines and pages are in no text
    return None if re.search(rb"[\x00-\x08\x0e-\x1f\x7f]", content) else "LATIN1"


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, whole or not at all; errors as of `write_atomically`."""
    write_atomically(path, encoded(text))


def append_line(path: str | Path, line: str) -> None:
    """Append a line to a text file, which is created if it is missing."""
    try:
        with open(path, "ab") as file:
            file.write(encoded(f"{line}\n"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); expected a folder to write in"
        ) from None


def encoded(text: str) -> bytes:
    """Text as UTF-8; of names of files, bytes that are not UTF-8 are spelled out."""
    return text.encode("utf-8", "backslashreplace")


def as_text(value: Any) -> str:
    """Text of an attribute or of a variable: bytes are decoded, characters of an array joined."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip("\0 ")
    if getattr(getattr(value, "dtype", None), "kind", "") == "S":
        return str(value.tobytes().decode("utf-8", "replace")).replace("\0", "").strip()
    return str(value).strip()
