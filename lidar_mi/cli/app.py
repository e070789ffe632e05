"""The command line: one command per file in this folder."""

from typing import Annotated

import typer

from lidar_mi.cli import (
    aerosol,
    calibrate,
    campaign,
    check,
    doctor,
    export,
    fly,
    info,
    render,
    retrieve,
    rings,
    run,
    v_los,
)
from lidar_mi.cli.exit_codes import exit_by

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


app.command(epilog=run.EXAMPLES)(run.run)
app.command(epilog=fly.EXAMPLES)(fly.fly)
app.command(epilog=check.EXAMPLES)(check.check)
app.command(epilog=render.EXAMPLES)(render.render)
app.command(epilog=retrieve.EXAMPLES)(retrieve.retrieve)
app.command(epilog=info.EXAMPLES)(info.info)
app.command(epilog=export.EXAMPLES)(export.export)
app.command(epilog=aerosol.EXAMPLES)(aerosol.aerosol)
app.command(epilog=rings.EXAMPLES)(rings.rings)
app.command(epilog=calibrate.EXAMPLES)(calibrate.calibrate)
app.add_typer(campaign.app, name="campaign")
app.command("v_los", epilog=v_los.EXAMPLES)(v_los.v_los)
app.command(epilog=doctor.EXAMPLES)(doctor.doctor)


def main() -> None:
    """Entry point of the command ``lidar-mi``."""
    exit_by(app)


if __name__ == "__main__":
    main()
