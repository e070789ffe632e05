"""Messages of a run, to its log file and to the terminal."""

import os
import re
import time
import traceback
from contextlib import suppress
from pathlib import Path

from lidar_mi.errors import InputError, one_line, printable
from lidar_mi.io.text import encoded
from lidar_mi.progress import Notice

FAILED = "failed: "
_TAIL = 1 << 16


def silent(text: str, fraction: float | None) -> None:
    """A `Notice` that does nothing."""


class Log:
    """Lines, progress and warnings of a run.

    path: file to which lines are appended, if there is one.
    warnings: those that matter for the results.
    """

    def __init__(self, notice: Notice = silent, path: Path | None = None):
        self.path, self.notice = path, notice
        self.warnings: list[str] = []

    def __call__(self, text: str) -> None:
        """Show a line, and write it into the file."""
        self._write(text)
        self.notice(text, None)

    def remark(self, text: str) -> None:
        """Warn of something that matters for the results, once."""
        if text in self.warnings:
            return
        self.warnings.append(text)
        self(f"warning: {text}")

    def fail(self, error: Exception) -> None:
        """Write the reason of a failure, so that the run is not mistaken for one to be resumed.

        With the traceback, unless it is bad input. If the disk is full, a failure to write this
        line is no further error.
        """
        text = f"{FAILED}{one_line(error) or type(error).__name__}"
        with suppress(InputError):
            if not isinstance(error, InputError):
                self._write("".join(traceback.format_exception(error)).rstrip())
            self._write(text)
        self.notice(text, None)

    def bar(self, text: str, fraction: float | None) -> None:
        """Show progress within a step; not written."""
        self.notice(text, fraction)

    def _write(self, text: str) -> None:
        if self.path is None:
            return
        line = encoded(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {printable(text)}\n")
        try:
            with open(self.path, "ab", opener=_no_link) as file:
                file.write(line)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be written ({error.strerror}); expected room for a log"
            ) from error


def _no_link(path: str, flags: int) -> int:
    """Open a file; not through a link, as lines would be appended to its target."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def failure(path: Path) -> str | None:
    """The error that ended the run of a log file; None: none, or it was only stopped."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        # only the end matters, and the file may have been edited
        file.seek(max(0, path.stat().st_size - _TAIL))
        lines = file.read(_TAIL).decode(errors="backslashreplace").splitlines()
    last = re.fullmatch(rf"\S+ \S+ {FAILED}(.*)", lines[-1]) if lines else None
    return one_line(last[1]) if last else None
