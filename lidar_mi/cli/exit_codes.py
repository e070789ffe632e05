"""From exceptions and signals to one printable line on stderr and an exit code."""

import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from lidar_mi.cli.terminal import errors
from lidar_mi.errors import InputError, Stopped, causes, is_interrupt, notes, one_line

if TYPE_CHECKING:
    import xarray as xr

NOTHING_FOUND = 1
BAD_INPUT = 2
BY_SIGNAL = 128
"""Exit code of a signal, less its number."""

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

TRACEBACK = "LIDAR_MI_TRACEBACK"
"""Environment variable; if set, tracebacks of all errors are shown."""

# typer's errors of arguments and options, from either library
_USAGE_ERROR = typer.BadParameter.__mro__[1]


def exit_by(app: Callable[..., int | None]) -> None:
    """Run a typer app; errors and signals are reported in one line.

    Exit code 1: `end_without_result`. Exit code 2: bad input, a disk or a file that fails, too
    little memory, equations that have no solution. Exit code 128 + n: signal n (Ctrl-C, SIGTERM,
    SIGHUP). Characters that the terminal has not are printed as escapes.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with _raised_signals():
            code = app(standalone_mode=False)
    except BaseException as error:
        if isinstance(error, _USAGE_ERROR):
            _fail_usage(error)
        stop = _stop(error)
        if stop is not None:
            word = "stopped" if stop == signal.SIGINT else f"stopped by {signal.Signals(stop).name}"
            _fail("; ".join([word, *notes(error)]), BY_SIGNAL + stop)
        message = _message(error)
        if message is None or (os.environ.get(TRACEBACK) and not isinstance(error, InputError)):
            raise
        _fail("; ".join([message, *notes(error)]), BAD_INPUT)
    sys.exit(code or 0)


def end_without_result(reason: str, flag: "xr.DataArray") -> NoReturn:
    """End a command whose result has no valid value, with the reasons that its flags give.

    flag: flags with the CF attributes ``flag_masks`` and ``flag_meanings``; none is 0.
    """
    _fail(f"{reason} (flags: {flags_in_words(flag)})", NOTHING_FOUND)


def flags_in_words(flag: "xr.DataArray") -> str:
    """How many vectors have each flag, from the CF attributes; empty: all are valid."""
    from lidar_mi.flags import masks_of

    counts = ((name, int((flag & mask != 0).sum())) for name, mask in masks_of(flag.attrs).items())
    return ", ".join(f"{name} {count}" for name, count in counts if count)


def _message(error: BaseException) -> str | None:
    """Message of an error; None: it is a fault of the program."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError):
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return ": ".join([*names, error.strerror or str(error)])
    # torch has no exception type for it
    no_memory = isinstance(error, RuntimeError) and "allocate memory" in str(error)
    if isinstance(error, MemoryError) or no_memory:
        return (
            f"not enough memory ({one_line(error, 100) or 'in all'}); expected fewer beams, gates "
            "or samples, or a larger machine"
        )
    # numpy, scipy and torch each have their own type
    if type(error).__name__.lstrip("_") == "LinAlgError":
        reason = one_line(error, 100)
        return f"equations without a solution ({reason}); expected data that determine it"
    return _plugin_message(error)


def _fail(message: str, code: int) -> NoReturn:
    line = one_line(message)
    with suppress(OSError):  # the terminal may be closed
        errors.print(f"lidar-mi: {line}", style="red", highlight=False, soft_wrap=True)
    sys.exit(code)


def _fail_usage(error: Any) -> NoReturn:
    """A wrong argument or option; without any, typer has shown the help."""
    message = error.format_message().rstrip(".")
    if not message:
        sys.exit(BAD_INPUT)
    name = error.ctx.command_path if error.ctx else "lidar-mi"
    hint = f"{' See' if message.endswith('?') else '; see'} {name} --help"
    _fail(f"{message[0].lower()}{message[1:]}{hint}", BAD_INPUT)


@contextmanager
def _raised_signals() -> Iterator[None]:
    """Terminating signals raise `Stopped`, except ignored ones (nohup)."""
    before = {number: signal.getsignal(number) for number in STOPPING}
    signals = [number for number, handler in before.items() if handler != signal.SIG_IGN]
    try:
        for number in signals:
            signal.signal(number, _raise_stopped)
        yield
    finally:
        for number in signals:
            signal.signal(number, before[number])


def _raise_stopped(number: int, frame: FrameType | None) -> None:
    raise Stopped(number)


def _stop(error: BaseException) -> int | None:
    """The signal that stopped the program, or None."""
    stops = [cause for cause in causes(error) if isinstance(cause, Stopped)]
    return stops[0].number if stops else signal.SIGINT if is_interrupt(error) else None


def _plugin_message(error: BaseException) -> str | None:
    """The one-line message of a plugin about a wrong parameter, without Mitsuba's own."""
    for cause in causes(error):
        for line in str(cause).splitlines():
            if " is not allowed; expected " in line:
                return line.split("ValueError: ")[-1].strip()
    return None
