"""``lidar-mi export``: results of a run for ParaView, a spreadsheet, MATLAB, control design."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import starting
from lidar_mi.cli.terminal import errors, output

EXAMPLES = (
    "lidar-mi export outputs/wake_sensor",
    "lidar-mi export outputs/wake_sensor --format csv -o tables",
    "lidar-mi export outputs/gust --format control",
    "lidar-mi export outputs/inflow --format openfast",
)


def complete_format(incomplete: str) -> list[str]:
    """Formats, for a shell."""
    return starting(incomplete, ("vtk", "csv", "mat", "openfast", "control"))


def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a run, of a flight, or of flights.")],
    format: Annotated[
        str,
        typer.Option(
            "--format",
            help="vtk (ParaView), csv (spreadsheets, R), mat (MATLAB), openfast (lines of a "
            "coherent lidar, as OpenFAST's own), or control: the lidar of flights as a state-space "
            "block with its noise (.npz, .mat for Simulink).",
            autocompletion=complete_format,
        ),
    ] = "vtk",
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder of the files. Default: a folder with the name of the format in FOLDER.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Write winds, volumes, images, lines of sight and vortices of a run as VTK, CSV or MATLAB.

    Of a flight: the path of the aircraft, the track of the vortices, winds and images of the slabs.
    With `--format control`, of a flight or of all flights below a folder: the lidar as a linear
    discrete-time system from the true wind ahead to its estimate, with delay and noise, for every
    range.
    """
    if format == "control":
        from lidar_mi.encounter.control_block.export import export_control

        paths = export_control(
            folder, out, overwrite=overwrite, remark=partial(errors.print, soft_wrap=True)
        )
    else:
        from lidar_mi.experiment import export as exporting

        paths = exporting.export(folder, format, out, overwrite=overwrite)
    for path in paths:
        output.print(str(path), soft_wrap=True)
