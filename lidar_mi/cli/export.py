"""``lidar-mi export``: results of a run for ParaView, a spreadsheet, MATLAB."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import starting
from lidar_mi.cli.terminal import output

EXAMPLES = (
    "lidar-mi export outputs/wake_sensor",
    "lidar-mi export outputs/wake_sensor --format csv -o tables",
)


def complete_format(incomplete: str) -> list[str]:
    """Formats, for a shell."""
    return starting(incomplete, ("vtk", "csv", "mat"))


def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a run or of a flight.")],
    format: Annotated[
        str,
        typer.Option(
            "--format",
            help="vtk (ParaView), csv (spreadsheets, R) or mat (MATLAB).",
            autocompletion=complete_format,
        ),
    ] = "vtk",
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Folder of the files. Default: one of the format's name in RUN."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that are there.")
    ] = False,
) -> None:
    """Write winds, volumes, images, lines of sight and vortices of a run as VTK, CSV or MATLAB.

    Of a flight: the aircraft's way, the track of the vortices, winds and images of the slabs.
    """
    from lidar_mi.experiment import export as exporting

    for path in exporting.export(folder, format, out, overwrite=overwrite):
        output.print(str(path), soft_wrap=True)
