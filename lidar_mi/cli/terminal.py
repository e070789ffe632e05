"""What commands print, to the terminal or into a pipe."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

# names in files and folders may hold brackets and colons: they are no markup
output = Console(markup=False, emoji=False)
errors = Console(stderr=True, markup=False, emoji=False)


def print_rows(title: str, rows: Iterable[tuple[str, ...]]) -> None:
    """A table without a head: a name and what there is to say of it, line by line."""
    table = Table(title=title, title_justify="left", show_header=False)
    for row in rows:
        table.add_row(*row)
    output.print(table)
