"""From exceptions to one printable line on stderr and an exit code."""

import sys
from collections.abc import Callable
from typing import Any, NoReturn

import typer

from lidar_mi.cli.terminal import errors
from lidar_mi.errors import InputError, causes, is_interrupt, one_line

BAD_INPUT = 2
INTERRUPTED = 130

_STOPPED = "stopped; start it again to resume the run"

# what typer finds wrong with arguments and options, whichever library it takes this from
_USAGE_ERROR = typer.BadParameter.__mro__[1]


def exit_by(app: Callable[..., int | None]) -> None:
    """Run a typer app; bad input ends it with one line and exit code 2, Ctrl-C with 130."""
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        _fail(str(error), BAD_INPUT)
    except BaseException as error:
        if isinstance(error, _USAGE_ERROR):
            _fail_usage(error)
        if is_interrupt(error):
            _fail(_STOPPED, INTERRUPTED)
        message = _plugin_message(error)
        if message is None:
            raise
        _fail(message, BAD_INPUT)
    if code == INTERRUPTED:  # typer catches Ctrl-C
        _fail(_STOPPED, INTERRUPTED)
    sys.exit(code or 0)


def _fail(message: str, code: int) -> NoReturn:
    line = one_line(message)
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


def _plugin_message(error: BaseException) -> str | None:
    """The one line a plugin said about a wrong parameter, from under the layers above it."""
    for cause in causes(error):
        for line in str(cause).splitlines():
            if " is not allowed; expected " in line:
                return line.split("ValueError: ")[-1].strip()
    return None
