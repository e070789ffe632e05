"""``lidar-mi vortices``: vortices of a wake from scans of a Doppler lidar."""

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
    "lidar-mi vortices rhi_*.nc --span '60 m' -o vortices.nc",
    "lidar-mi vortices rhi.hpl --ground '-1.5 m' --pulse-length '30 m' --noise '0.1 m/s'",
    "lidar-mi vortices lines.csv --kind single --profile burnham_hallock -o vortices.csv",
)

_ROWS = 24


class Kind(enum.StrEnum):
    """What a wake consists of."""

    PAIR = "pair"
    SINGLE = "single"


class Profile(enum.StrEnum):
    """Of the swirl."""

    LAMB_OSEEN = "lamb_oseen"
    BURNHAM_HALLOCK = "burnham_hallock"


def vortices(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Vertical slices (RHI) of one lidar (.hpl, NetCDF of ARM, WindCube or CfRadial, "
            ".csv)."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("-o", "--out", help="File of the vortices, NetCDF (.nc) or table (.csv)."),
    ] = Path("vortices.nc"),
    plot: Annotated[
        Path | None,
        typer.Option(help="Figure (PNG). Default: that of the vortices' name with .png."),
    ] = None,
    kind: Annotated[Kind, typer.Option(help="pair or single.")] = Kind.PAIR,
    profile: Annotated[
        Profile, typer.Option(help="Of the swirl: lamb_oseen or burnham_hallock.")
    ] = Profile.LAMB_OSEEN,
    span: Annotated[
        str | None, typer.Option(help="Of the aircraft's wing. Default: unknown, 28 to 81 m.")
    ] = None,
    ground: Annotated[
        str | None,
        typer.Option(help="Height of the ground above the lidar, '-2 m'. Default: no ground."),
    ] = None,
    core_radius: Annotated[
        str | None, typer.Option(help="Likely core radius. Default: 5 % of the span, or 3 m.")
    ] = None,
    pulse_length: Annotated[
        str | None,
        typer.Option(help="Full width at half maximum in range. Default: of the file, or a gate."),
    ] = None,
    gate_length: Annotated[
        str | None, typer.Option(help="Of the time window. Default: of the file, or adjacent.")
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            help="Least standard error of the velocities: '0.1 m/s'. Default: from the lines."
        ),
    ] = None,
    false_alarm: Annotated[
        float, typer.Option(help="Of scans without a wake, the fraction that may show one.")
    ] = 0.01,
    min_cnr: MinCnr = None,
    name: LineNames = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the vortices of a wake in vertical slices of a Doppler lidar, with their errors.

    Exit code 1: no scan has valid vortices; the file says why.
    """
    import numpy as np

    from lidar_mi import __version__
    from lidar_mi.assessment.figures.line_vortices import draw_line_vortices
    from lidar_mi.io.csv_file import write_csv
    from lidar_mi.io.lines_of_sight.read import read_lines_of_sight
    from lidar_mi.io.netcdf import write_netcdf
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target
    from lidar_mi.progress import progress
    from lidar_mi.retrieval.ground_vortices.vortices import fit_vortices_to_lines

    figure = plot or out.with_suffix(".png")
    check_target(out, files, overwrite=overwrite, suffixes=(".nc", ".csv"))
    check_target(figure, files, overwrite=overwrite, suffixes=(".png",))
    lines = read_lines_of_sight(files, names=names_of(name or ()), min_cnr=min_cnr)
    print_remarks(lines.attrs["remarks"])
    with progress() as notice:
        fits = fit_vortices_to_lines(
            lines,
            kind=kind.value,
            profile=profile.value,
            span=quantity("--span", span, "m", "60 m"),
            ground=quantity("--ground", ground, "m", "-2 m"),
            core_radius=quantity("--core-radius", core_radius, "m", "3 m"),
            pulse_length=quantity("--pulse-length", pulse_length, "m", "30 m"),
            gate_length=quantity("--gate-length", gate_length, "m", "30 m"),
            noise=quantity("--noise", noise, "m/s", "0.1 m/s"),
            false_alarm=false_alarm,
            notice=notice,
        )
    print_remarks(fits.attrs["remarks"])
    if np.isfinite(fits["y"]).any():
        _show(fits)
    if out.suffix.lower() == ".nc":
        write_netcdf(fits.assign_attrs(software=f"lidar-mi {__version__}"), out)
    else:
        write_csv(out, fits.drop_dims(["number", "other_number"]))
    output.print(f"vortices {out}")
    write_png(draw_line_vortices(lines, fits, files[0].name), figure)
    output.print(f"figure   {figure}")
    if not (fits["flag"] == 0).any():
        end_without_result(f"no valid vortices, number of scans {fits.sizes['scan']}", fits["flag"])


def _show(fits: "xr.Dataset") -> None:
    """A table of the scans with a wake, and how many there are."""
    import numpy as np

    from lidar_mi.tables import Table, shown_part, with_error

    valid = (fits["flag"] == 0).values
    chosen = np.flatnonzero(np.isfinite(fits["y"].values).all(1))
    rows = []
    step = max(1, -(-chosen.size // _ROWS))
    for k in chosen[::step]:
        scan = fits.isel(scan=int(k))
        for v in range(fits.sizes["vortex"]):
            rows.append(
                (
                    str(scan["time"].values)[11:21],
                    *(
                        with_error(float(scan[n][v]), float(scan[f"{n}_stderr"][v]))
                        for n in ("y", "z", "circulation", "core_radius")
                    ),
                    "" if valid[k] else "not valid",
                )
            )
    heads = ("time (UTC)", "y, m", "z, m", "circulation, m²/s", "core radius, m", "")
    wakes = int((fits["flag"].values & 1 == 0).sum())
    note = f"{wakes} of {valid.size} scans show a wake, {int(valid.sum())} have a valid fit."
    if step > 1:
        note += f" Shown: {shown_part(chosen.size, step, 'scan')}."
    print_table(Table("vortices", rows, heads, note))
