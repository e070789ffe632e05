"""From exceptions to one line on stderr and an exit code."""

import sys
from collections.abc import Callable

from lidar_mi.cli.terminal import errors
from lidar_mi.errors import InputError, causes, is_interrupt

BAD_INPUT = 2
INTERRUPTED = 130


def exit_by(command: Callable[[], None]) -> None:
    """Run a command; bad input ends it with one line and exit code 2, Ctrl-C with 130."""
    try:
        command()
    except InputError as error:
        _fail(str(error), BAD_INPUT)
    except BaseException as error:
        if is_interrupt(error):
            _fail("stopped; a run goes on when started again", INTERRUPTED)
        message = _plugin_message(error)
        if message is None:
            raise
        _fail(message, BAD_INPUT)


def _fail(message: str, code: int) -> None:
    errors.print(f"lidar-mi: {message}", style="red", highlight=False, soft_wrap=True)
    sys.exit(code)


def _plugin_message(error: BaseException) -> str | None:
    """The one line a plugin said about a wrong parameter, from under the layers above it."""
    for cause in causes(error):
        for line in str(cause).splitlines():
            if " is not allowed; expected " in line:
                return line.split("ValueError: ")[-1].strip()
    return None
