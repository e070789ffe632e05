"""An experiment file to start from: the keys of a shipped experiment, each with what it does."""

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lidar_mi.io.yaml import to_yaml_line
from lidar_mi.schema.keys import OF_A_FILE, explain, keys_of, sections
from lidar_mi.schema.reading import read_keys

_WIDTH = 100
_HEAD = """\
# {name}: like the shipped experiment {shipped}.
#
#   {check:{width}}  can it be run, and what does it describe, in numbers?
#   {run:{width}}  writes outputs/{name}
#   {explain:{width}}  what the keys of a section do
#
# Keys that are not here have their defaults. Quantities have units: 500 m, 2 mrad, 1.8 / km.
"""


def new_file(name: str, shipped: str, path: Path, command: str) -> str:
    """Text of an experiment file with the keys of a shipped experiment, its base's included.

    name: of the new experiment.
    shipped: name of the shipped experiment.
    path: its file.
    command: that runs it: run or fly.

    Returns
    -------
    str
        YAML, with a comment on every key and the names of the keys that a section has besides.
    """
    data = read_keys(path) | {"name": name}
    # shipped experiments have the paper's air; a user's has molecules
    real = data.get("wake", {}).get("extinction", {}).get("molecules") == 0
    if real:
        data["wake"]["extinction"]["molecules"] = "auto"
    commands = {
        "check": f"lidar-mi check {name}.yaml",
        "run": f"lidar-mi {command} {name}.yaml",
        "explain": "lidar-mi explain scan",
    }
    head = _HEAD.format(
        name=name, shipped=shipped, width=max(map(len, commands.values())), **commands
    )
    if real:
        head += "# Molecules of the site's air scatter as well; in the shipped one none do.\n"
    variants = data.pop("variants", {})
    lines = list(_section(data, "", 0, set()))
    absent = [key for key in sections() if key not in data]
    lines += ["", *_comment(f"more sections: {', '.join(absent)} (lidar-mi explain SECTION)", 0)]
    if variants:
        lines += ["", *_comment(OF_A_FILE["variants"], 0), "variants:"]
        explained: set[str] = set()
        for variant, changes in variants.items():
            start = f"  {variant}:" if changes else f"  {variant}: {{}}"
            lines += [start, *_section(changes, "", 4, explained, more=False)]
    return head + "\n".join(lines) + "\n"


def _section(
    data: dict[str, Any], above: str, indent: int, explained: set[str], *, more: bool = True
) -> Iterator[str]:
    """Lines of a section: its keys with what they do, and the names of others.

    Keys that are in ``explained`` are not explained again.
    """
    for key, value in data.items():
        entry = explain(f"{above}{key}")
        start = f"{' ' * indent}{key}:"
        about = "" if entry.name in explained else entry.meaning
        explained.add(entry.name)
        if indent == 0 and entry.keys:
            yield ""
        if isinstance(value, dict) and value and entry.keys:
            yield from _with_comment(start, about)
            yield from _section(value, f"{entry.name}.", indent + 2, explained, more=more)
        else:
            yield from _with_comment(f"{start} {to_yaml_line(value)}", about)
    remaining = [name for name in keys_of(above[:-1], data) if name not in explained]
    if more and remaining:
        last = ", ".join(name.rpartition(".")[2] for name in remaining)
        yield from _comment(f"more: {last}", indent)


def _with_comment(line: str, comment: str) -> Iterator[str]:
    """A line with its comment, which stands above it where both are too long."""
    if comment and len(line) + len(comment) + 4 > _WIDTH:
        yield from _comment(comment, len(line) - len(line.lstrip()))
    elif comment:
        line = f"{line}  # {comment}"
    yield line


def _comment(text: str, indent: int) -> list[str]:
    start = f"{' ' * indent}# "
    return textwrap.wrap(text, _WIDTH, initial_indent=start, subsequent_indent=start)
