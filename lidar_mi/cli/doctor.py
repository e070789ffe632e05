"""``lidar-mi doctor``: checks of this machine."""

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

EXAMPLES = ("lidar-mi doctor",)


def doctor() -> None:
    """Check what this machine can run, and list what to install for the rest.

    Exit code 0: all requirements are met.
    """
    from lidar_mi.system.doctor import doctor as examine

    console = Console()
    with console.status("examining this machine"):
        checkup = examine()
    marks = {True: Text("ok", "green"), False: Text("FAILED", "bold red"), None: Text("-", "dim")}
    table = Table(box=None, pad_edge=False)
    for heading in ("", "what", "found"):
        table.add_column(heading, overflow="fold")
    for check in checkup.checks:
        table.add_row(marks[check.ok], Text(check.name), Text(check.detail))
    console.print(table)
    for check in checkup.checks:
        if check.remedy:
            kind = "to repair" if check.ok is False else "optional"
            console.print(Text(f"{kind}: {check.name}: {check.remedy}"), soft_wrap=True)
    failed, number = len(checkup.failed), len(checkup.checks)
    console.print(f"{failed} of {number} checks failed" if failed else "all checks passed")
    raise typer.Exit(1 if failed else 0)
