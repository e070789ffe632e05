"""The command line: one command per file in this folder."""

from typing import Annotated

import typer

from lidar_mi.cli import (
    aerosol,
    calibrate,
    campaign,
    check,
    doctor,
    explain,
    export,
    fly,
    info,
    new,
    render,
    retrieve,
    rings,
    run,
    v_los,
    vortices,
    winds,
)
from lidar_mi.cli import list as listing
from lidar_mi.cli.exit_codes import exit_by
from lidar_mi.cli.options import examples

app = typer.Typer(
    name="lidar-mi",
    help="Virtual lidars that observe wake vortices: from a simulated wake to retrieved winds.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from lidar_mi import __version__

        print(f"lidar-mi {__version__}")
        raise typer.Exit


app.command("list", epilog=examples(*listing.EXAMPLES))(listing.list_shipped)
app.command(epilog=examples(*new.EXAMPLES))(new.new)
app.command(epilog=examples(*explain.EXAMPLES))(explain.explain)
app.command(epilog=examples(*run.EXAMPLES))(run.run)
app.command(epilog=examples(*fly.EXAMPLES))(fly.fly)
app.command(epilog=examples(*check.EXAMPLES))(check.check)
app.command(epilog=examples(*render.EXAMPLES))(render.render)
app.command(epilog=examples(*retrieve.EXAMPLES))(retrieve.retrieve)
app.command(epilog=examples(*info.EXAMPLES))(info.info)
app.command(epilog=examples(*export.EXAMPLES))(export.export)
app.command(epilog=examples(*aerosol.EXAMPLES))(aerosol.aerosol)
app.command(epilog=examples(*rings.EXAMPLES))(rings.rings)
app.command(epilog=examples(*calibrate.EXAMPLES))(calibrate.calibrate)
app.add_typer(campaign.app, name="campaign")
app.command("v_los", epilog=examples(*v_los.EXAMPLES))(v_los.v_los)
app.command(epilog=examples(*vortices.EXAMPLES))(vortices.vortices)
app.command(epilog=examples(*winds.EXAMPLES))(winds.winds)
app.command(epilog=examples(*doctor.EXAMPLES))(doctor.doctor)


def main() -> None:
    """Entry point of the command ``lidar-mi``."""
    exit_by(app)


if __name__ == "__main__":
    main()
