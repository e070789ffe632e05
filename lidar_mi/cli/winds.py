"""``lidar-mi winds``: profiles of the wind from scans of a Doppler lidar."""

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar_mi.cli.exit_codes import end_without_result
from lidar_mi.cli.options import LineNames, MinCnr, Overwrite, names_of, quantity
from lidar_mi.cli.terminal import output, print_remarks, print_table

if TYPE_CHECKING:
    import xarray as xr

EXAMPLES = (
    "lidar-mi winds VAD_194_20210624_170110.hpl -o winds.nc",
    "lidar-mi winds sgpdlppiC1.b1.*.cdf --range-step '3 m' --noise '0.1 m/s' -o winds.nc",
    "lidar-mi winds lines.csv --name radial_velocity=-v_los -o winds.csv",
)

_ROWS = 12


class Layout(enum.StrEnum):
    """Names in a file of winds."""

    CF = "cf"
    ACTRIS = "actris"


def winds(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Lines of sight of one lidar: VAD, DBS or PPI scans (.hpl, NetCDF of ARM, "
            "WindCube or CfRadial, .csv)."
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="File of the winds, NetCDF (.nc) or table (.csv).")
    ] = Path("winds.nc"),
    plot: Annotated[
        Path | None, typer.Option(help="Figure (PNG). Default: that of the winds' name with .png.")
    ] = None,
    interval: Annotated[
        str | None, typer.Option(help="Time of a profile: '10 min'. Default: one for every scan.")
    ] = None,
    height_step: Annotated[
        str | None, typer.Option(help="Default: the heights of the gates.")
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(help="Standard error of every velocity: '0.1 m/s'. Default: unknown."),
    ] = None,
    length_scale: Annotated[
        str | None, typer.Option(help="Of the turbulence. Default: unknown, 50 to 800 m.")
    ] = None,
    min_cnr: MinCnr = None,
    blind_range: Annotated[
        str | None, typer.Option(help="Gates nearer than this are not used. Default: by the lidar.")
    ] = None,
    range_step: Annotated[
        str | None, typer.Option(help="Distance of the gates, where that of the file is wrong.")
    ] = None,
    name: LineNames = None,
    layout: Annotated[
        Layout, typer.Option(help="Of the file: cf (u, v, w) or actris (uwind, vwind, as doppy's).")
    ] = Layout.CF,
    overwrite: Overwrite = False,
) -> None:
    """Retrieve profiles of the wind from scans of a Doppler lidar, with their errors.

    Exit code 1: no wind is valid; the file says why.
    """
    from lidar_mi import __version__
    from lidar_mi.assessment.figures.wind_profile import draw_wind_profiles
    from lidar_mi.io.actris_wind import in_actris_layout
    from lidar_mi.io.csv_file import write_csv
    from lidar_mi.io.lines_of_sight.read import read_lines_of_sight
    from lidar_mi.io.netcdf import write_netcdf
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.ground_winds.winds import fit_winds_to_lines

    figure = plot or out.with_suffix(".png")
    check_target(out, files, overwrite=overwrite, suffixes=(".nc", ".csv"))
    check_target(figure, files, overwrite=overwrite, suffixes=(".png",))
    lines = read_lines_of_sight(
        files,
        names=names_of(name or ()),
        min_cnr=min_cnr,
        blind_range=quantity("--blind-range", blind_range, "m", "90 m"),
        range_step=quantity("--range-step", range_step, "m", "3 m"),
    )
    print_remarks(lines.attrs["remarks"])
    profiles = fit_winds_to_lines(
        lines,
        interval=quantity("--interval", interval, "s", "10 min"),
        height_step=quantity("--height-step", height_step, "m", "30 m"),
        noise=quantity("--noise", noise, "m/s", "0.1 m/s"),
        length_scale=quantity("--length-scale", length_scale, "m", "200 m"),
    )
    valid = int((profiles["flag"] == 0).sum())
    if valid:
        _show(profiles)
    output_data = in_actris_layout(profiles) if layout is Layout.ACTRIS else profiles
    if out.suffix.lower() == ".nc":
        write_netcdf(output_data.assign_attrs(software=f"lidar-mi {__version__}"), out)
    else:
        write_csv(out, output_data)
    output.print(f"winds    {out}")
    if not valid:
        end_without_result(f"no valid wind of {profiles['flag'].size}", profiles["flag"])
    write_png(draw_wind_profiles(profiles, files[0].name), figure)
    output.print(f"figure   {figure}")


def _show(winds: "xr.Dataset") -> None:
    """A table of valid winds, a few heights of the first profile, and how many there are."""
    import numpy as np

    from lidar_mi.tables import Table, shown_part, with_error

    valid = (winds["flag"] == 0).values
    profile = int(np.argmax(valid.any(1)))
    wind = winds.isel(time=profile)
    heights = np.flatnonzero(valid[profile])
    step = max(1, -(-heights.size // _ROWS))
    chosen = heights[::step]
    rows = [
        (
            f"{float(wind['height'][k]):.0f}",
            *(with_error(float(wind[c][k]), float(wind[f"{c}_stderr"][k])) for c in "uvw"),
            f"{float(wind['residual'][k]):.2f}",
            str(int(wind["lines"][k])),
        )
        for k in chosen
    ]
    heads = ("height, m", "u (east), m/s", "v (north), m/s", "w (up), m/s", "residual", "lines")
    time = str(wind["time"].values)[:19].replace("T", " ")
    number = valid.shape[0]
    profiles = f"{number} profile{'s' if number > 1 else ''}"
    note = f"{int(valid.sum())} of {valid.size} winds are valid, of {profiles}."
    if step > 1 or number > 1:
        note += f" Shown: {shown_part(heights.size, step, 'height')} of this one."
    print_table(Table(f"wind, {time} UTC", rows, heads, note))
