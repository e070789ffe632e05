"""Page reference/commands.md from the help of the command line."""

import re
from collections.abc import Iterator

import typer

from lidar_mi.cli.app import app

HEAD = """\
# Command line

<!-- Written by docs/make_command_reference.py from the help of the commands; edit those. -->

`lidar-mi COMMAND --help` says the same. `lidar-mi --install-completion` lets your shell complete
commands, options, names of experiments and keys behind `--set`. A command ends with 0 if it is
done, with 2 if its input is refused (one line says why), and with 130 if it is interrupted.
"""


def pages() -> dict[str, str]:
    """Text of the page by its place below ``docs``."""
    commands = typer.main.get_command(app).commands
    parts = [part for name, one in commands.items() for part in _command(name, one)]
    return {"reference/commands.md": "\n\n".join([HEAD.rstrip(), *parts]) + "\n"}


def _command(name: str, command, depth: int = 2) -> Iterator[str]:
    """A command, and those of which it is the first word."""
    yield f"{'#' * depth} {name}"
    yield _prose(command.help)
    rows = [row for one in command.params if not one.hidden for row in _rows(one)]
    if rows:
        yield "\n".join(["| argument | meaning |", "| --- | --- |", *rows])
    if command.epilog:
        yield _examples(command.epilog)
    for inner, one in getattr(command, "commands", {}).items():
        yield from _command(f"{name} {inner}", one, depth + 1)


def _rows(parameter) -> Iterator[str]:
    about = _prose(parameter.help or "").replace("\n", " ").replace("|", r"\|")
    if parameter.param_type_name == "argument":
        word = (parameter.metavar or parameter.name).upper()
        if parameter.multiple or parameter.nargs != 1:
            word += " ..."
        yield f"| {f'`{word}`' if parameter.required else f'`[{word}]`'} | {about} |"
        return
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    value = "" if parameter.is_flag else f" `{parameter.metavar or 'VALUE'}`"
    default = parameter.default
    if default not in (None, False, True, ()) and "Default" not in about:
        about += f" Default: {default}."
    elif parameter.required:
        about += " Required."
    yield f"| {names}{value} | {about} |"


def _prose(text: str) -> str:
    text = re.sub(r"\$\w+", r"`\g<0>`", text or "")  # no formula
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def _examples(epilog: str) -> str:
    """Commands of the list of examples as lines of a block."""
    lines = [line[3:-1] for line in epilog.splitlines() if line.startswith("- `")]
    return "\n".join(["```text", *lines, "```"])
