"""``lidar-mi calibrate``: an etalon's instrument from frames of its laser."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Changes, Electrons, NominalInstrument, Overwrite
from lidar_mi.cli.terminal import output, print_table

EXAMPLES = (
    "Examples: `lidar-mi calibrate laser_*.tif --instrument my_etalon.yaml -o etalon.nc` - "
    "`lidar-mi calibrate laser.fits --flat white.fits --set doppler.camera.pixel='5.5 um'`"
)


def calibrate(
    frames: Annotated[
        list[Path],
        typer.Argument(
            help="Frames of the laser's own light: EXR, PNG, TIFF (also of several pages) or FITS "
            "(also cubes); two at least, twenty are good."
        ),
    ],
    instrument: NominalInstrument = "fringes_paper",
    changes: Changes = None,
    flat: Annotated[
        list[Path] | None, typer.Option(help="Frames of even white light, once per file.")
    ] = None,
    electrons: Electrons = False,
    light_degree: Annotated[int, typer.Option(help="Degree of the illumination's polynomial.")] = 2,
    background_degree: Annotated[
        int, typer.Option(help="Degree of the background's polynomial; 8 for stray light.")
    ] = 4,
    max_chi_square: Annotated[float, typer.Option(help="Frames that fit worse are refused.")] = 2.0,
    layer: Annotated[str | None, typer.Option(help="Layer of EXR files.")] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="NetCDF file.")] = Path("etalon.nc"),
    overwrite: Overwrite = False,
) -> None:
    """Calibrate an etalon from frames of its laser: focal length, tilt, distortion, finesse, light.

    Writes the calibration (NetCDF) and, beside it, a figure of the misfit (PNG).
    """
    from lidar_mi import __version__
    from lidar_mi.assessment.figures.calibration import draw_calibration
    from lidar_mi.experiment.own_frames import calibrate_etalon, doppler_of, read_electrons
    from lidar_mi.experiment.reading import load
    from lidar_mi.experiment.shipped import experiment_file
    from lidar_mi.io.netcdf import write_netcdf
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target

    figure = out.with_suffix(".png")
    given = [*frames, *(flat or [])]
    for path in (out, figure):
        check_target(path, given, overwrite=overwrite)
    experiment = load(experiment_file(instrument), list(changes or []))
    ccd, counts = doppler_of(experiment, "--instrument").ccd, not electrons
    values = read_electrons(frames, ccd, counts=counts, layer=layer)
    white = None
    if flat:
        white = read_electrons(flat, ccd, counts=counts, layer=layer).mean(0)
    found = calibrate_etalon(
        values,
        experiment,
        flat=white,
        light_degree=light_degree,
        background_degree=background_degree,
        max_chi_square=max_chi_square,
    )
    write_netcdf(found.to_dataset().assign_attrs(software=f"lidar-mi {__version__}"), out)
    write_png(draw_calibration(found), figure)
    for table in found.tables():
        print_table(table)
    output.print(f"calibration {out}")
    output.print(f"figure      {figure}")
