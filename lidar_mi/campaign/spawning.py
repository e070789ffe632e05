"""Worker processes of this machine: whether they can start, and why not.

A worker is a new interpreter that imports the main module of the program (``spawn``). Its faults
appear only in that process, and dask notices them after a minute. So one process that does nothing
is started first, with its output hidden from the terminal.
"""

import errno
import logging
import multiprocessing
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import process, spawn

from lidar_mi.errors import InputError, causes, one_line

PATIENCE = 300.0
"""Longest time for a process to start on a busy machine, s."""

_FILES, _FILES_EACH = 16, 11
"""Files that dask opens in this process, and for each worker: 25, 35 and 56 for 1, 2 and 4."""

_GUARD = "the script needs if __name__ == '__main__': before what it starts"
_TOO_FEW = "too few open files are allowed (ulimit -n); expected 64 and 16 for every worker"
# multiprocessing's message for a main module that starts processes on import
_IMPORTING = "bootstrapping phase"


def refuse_while_importing() -> None:
    """Raise InputError in a worker that imports a script which starts workers itself."""
    # multiprocessing sets it while a new process imports the main module
    if getattr(process.current_process(), "_inheriting", False):
        raise InputError(_GUARD)


def check_spawning(count: int) -> None:
    """Start a process as ``count`` workers will be started, and wait for its end.

    Raises InputError: it does not start, or fails as it imports the main module; too few files may
    be open.
    """
    if not _may_open(_FILES + _FILES_EACH * count):
        raise _refused(_TOO_FEW)
    # a file, not a pipe, which could fill up and block the process
    with tempfile.TemporaryFile() as output:
        try:
            with _output_to(output.fileno()):
                process = multiprocessing.get_context("spawn").Process(target=os.getpid)
                # the child inherits the output: it is restored here at once
                process.start()
            process.join(PATIENCE)
        except (OSError, RuntimeError, ValueError) as error:
            raise _not_started(error) from None
        if process.exitcode == 0:
            return
        if process.exitcode is None:
            process.kill()
            process.join()
            raise _refused(f"the first had not started after {PATIENCE:g} s")
        output.seek(0)
        text = output.read().decode(errors="replace").strip()
    if _GUARD in text or _IMPORTING in text:
        raise _refused(_GUARD)
    interpreter = os.fsdecode(spawn.get_executable())
    if not os.access(interpreter, os.X_OK):
        raise _refused(f"{interpreter} may not be executed")
    # the last line of a traceback is the exception
    raise _refused(text.splitlines()[-1] if text else f"exit code {process.exitcode}")


@contextmanager
def workers_started() -> Iterator[None]:
    """Report any failure to start workers in one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise _not_started(error) from None


@contextmanager
def quiet_loggers() -> Iterator[None]:
    """Suppress tracebacks that dask and its libraries log before they raise."""
    loggers = [logging.getLogger(name) for name in ("asyncio", "tornado", "distributed")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _may_open(number: int) -> bool:
    # tried, since limits of the process, of the user and of the machine all apply
    opened: list[int] = []
    try:
        while len(opened) < number:
            opened.extend(os.pipe())
    except OSError:
        return False
    finally:
        for descriptor in opened:
            os.close(descriptor)
    return True


def _not_started(error: BaseException) -> InputError:
    numbers = [getattr(cause, "errno", None) for cause in causes(error)]
    if errno.EMFILE in numbers or errno.ENFILE in numbers or not _may_open(_FILES_EACH):
        return _refused(_TOO_FEW)
    # dask wraps the cause in its own exceptions
    first = list(causes(error))[-1]
    return _refused(one_line(first, 150) or type(first).__name__)


def _refused(reason: str) -> InputError:
    return InputError(f"workers: the worker processes did not start: {reason}")


@contextmanager
def _output_to(target: int) -> Iterator[None]:
    """Standard output and error of processes that start meanwhile, to a file descriptor."""
    saved = {}
    try:
        for number in (1, 2):
            saved[number] = os.dup(number)
            os.dup2(target, number)
        yield
    finally:
        for number, before in saved.items():
            os.dup2(before, number)
            os.close(before)
