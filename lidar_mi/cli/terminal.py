"""Output of commands, to the terminal or into a pipe."""

from collections.abc import Sequence

import rich.table

from lidar_mi.progress import Terminal
from lidar_mi.tables import Table

output = Terminal()
errors = Terminal(stderr=True)


def print_answer(sentences: Sequence[str]) -> None:
    """The answer of a run, a sentence a line."""
    for sentence in sentences:
        output.print(sentence, soft_wrap=True)


def print_remarks(text: str) -> None:
    """Remarks on files, one a line."""
    for remark in text.splitlines():
        output.print(f"remark: {remark}", soft_wrap=True)


def print_rows(title: str, rows: Sequence[Sequence[str]]) -> None:
    """A table without a head: names and values, line by line."""
    print_table(Table(title, rows))


def print_table(table: Table) -> None:
    """Any table, in a frame."""
    framed = rich.table.Table(
        title=table.title, title_justify="left", show_header=bool(table.heads)
    )
    for k, head in enumerate(table.heads or ("",) * len(next(iter(table.rows), ()))):
        framed.add_column(head, justify="right" if k and table.heads else "left")
    for row in table.rows:
        framed.add_row(*row)
    # two columns less, where words would be cut
    wide = output.measure(framed, options=output.options.update(max_width=1000)).maximum
    framed.pad_edge = not table.heads or wide <= output.width
    output.print(framed)
    if table.note:
        output.print(table.note)
