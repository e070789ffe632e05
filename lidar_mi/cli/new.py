"""``lidar-mi new``: an experiment file of one's own."""

import re
from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import complete_instrument, complete_shipped
from lidar_mi.cli.terminal import output
from lidar_mi.errors import InputError

EXAMPLES = (
    "lidar-mi new my_wake",
    "lidar-mi new my_sensor --from wake_sensor",
    "lidar-mi new my_flight --from encounter",
    "lidar-mi new my_lidar --like halo_streamline",
)


def new(
    name: Annotated[
        str, typer.Argument(help="Name of the experiment, whose file will be NAME.yaml.")
    ],
    shipped: Annotated[
        str,
        typer.Option(
            "--from",
            help="Shipped experiment to start from, see `lidar-mi list`.",
            autocompletion=complete_shipped,
        ),
    ] = "wake_backscatter",
    like: Annotated[
        str | None,
        typer.Option(
            help="Published instrument to start from, each number with its source: "
            "docs/instruments.md lists them.",
            autocompletion=complete_instrument,
        ),
    ] = None,
) -> None:
    """Write an experiment file to edit, with the keys of a shipped one and what each does.

    With --like it is that of a published instrument. A file that is there is not replaced.
    """
    from lidar_mi.io.text import read_text, write_text
    from lidar_mi.schema.experiment import NAME
    from lidar_mi.schema.faults import A_NAME
    from lidar_mi.schema.new_file import new_file
    from lidar_mi.schema.shipped import experiments, flights, instrument_file, shipped_file

    path = Path(name if name.endswith(".yaml") else f"{name}.yaml")
    stem = path.stem
    if not re.fullmatch(NAME, stem):
        raise InputError(f"{name}: not allowed; expected {A_NAME}")
    if stem in experiments():
        raise InputError(f"{name}: a shipped experiment has this name; expected another one")
    source = shipped_file(shipped) if like is None else instrument_file(like)
    if path.exists():
        raise InputError(f"{path}: is there already; expected a new name")
    if like is None:
        command = "fly" if source.stem in flights() else "run"
        text = new_file(stem, source.stem, source, command)
    else:
        text = re.sub(r"(?m)^name: .*", f"name: {stem}", read_text(source, "an instrument"))
    write_text(path, text)
    output.print(f"file     {path}", soft_wrap=True)
    output.print(f"next     lidar-mi check {path}", soft_wrap=True)
