"""``lidar-mi explain``: what a key of an experiment file does."""

from typing import Annotated

import typer

from lidar_mi.cli.options import complete_key
from lidar_mi.cli.terminal import output, print_rows

EXAMPLES = (
    "lidar-mi explain",
    "lidar-mi explain scan.gates",
    "lidar-mi explain encounter",
    "lidar-mi explain pulse_energy",
)


def explain(
    key: Annotated[
        str | None,
        typer.Argument(
            help="Key or section of an experiment file, levels separated by dots. Default: all "
            "sections.",
            autocompletion=complete_key,
        ),
    ] = None,
) -> None:
    """Explain a key of an experiment file: what it does, its unit, its default, what is allowed.

    Of a section, also its keys. Of a mistyped key, the nearest one.
    """
    from lidar_mi.schema import keys

    if key is None:
        top = (*keys.OF_A_FILE, *keys.sections())
        rows = [(name, keys.explain(name).meaning) for name in top]
        print_rows("keys of an experiment file", rows)
        output.print("of one: lidar-mi explain KEY")
        return
    entry = keys.explain(key.strip())
    facts = (
        ("meaning", entry.meaning),
        ("unit", entry.unit),
        ("default", entry.default),
        ("allowed", entry.allowed),
        ("of each in", entry.listed_in),
        ("example", entry.example),
    )
    print_rows(entry.name, [fact for fact in facts if fact[1]])
    for paragraph in entry.more:
        if paragraph.removesuffix(".") != entry.meaning:
            output.print(f"\n{paragraph}", highlight=False)
    if entry.keys:
        output.print()
        inner = [keys.explain(name) for name in entry.keys]
        print_rows(
            f"keys of {entry.name}: default, meaning",
            [(key.name.rpartition(".")[2], key.default or "section", key.meaning) for key in inner],
        )
