"""``lidar-mi calibrate``: an etalon's instrument from frames of its laser, and of lamps."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Changes, Electrons, NominalInstrument, Overwrite, quantity
from lidar_mi.cli.terminal import output, print_table
from lidar_mi.errors import InputError

EXAMPLES = (
    "lidar-mi calibrate laser_*.tif --instrument my_etalon.yaml -o etalon.nc",
    "lidar-mi calibrate laser.tif --line '404.7708 nm=lamp.tif' --gap-tolerance '20 um'",
    "lidar-mi calibrate laser.fits --flat white.fits --set doppler.camera.pixel='5.5 um'",
)


def calibrate(
    frames: Annotated[
        list[Path],
        typer.Argument(
            help="Frames of the laser's own light: images of any kind, TIFF also of several pages, "
            "FITS and arrays also cubes; two at least, twenty are good."
        ),
    ],
    instrument: NominalInstrument = "fringes_paper",
    changes: Changes = None,
    flat: Annotated[
        list[Path] | None, typer.Option(help="Frames of even white light, once per file.")
    ] = None,
    line: Annotated[
        list[str] | None,
        typer.Option(
            help="Frames of another narrow line, WAVELENGTH=FILE, once per file: gives the gap."
        ),
    ] = None,
    gap_tolerance: Annotated[
        str, typer.Option(help="What the gap may differ by from the nominal one.")
    ] = "10 um",
    wavelength_accuracy: Annotated[
        float, typer.Option(help="Relative standard error of the lines' wavelengths.")
    ] = 1e-8,
    chromatic: Annotated[
        bool, typer.Option("--chromatic", help="Focal length and blur differ from line to line.")
    ] = False,
    electrons: Electrons = False,
    light_degree: Annotated[int, typer.Option(help="Degree of the illumination's polynomial.")] = 2,
    background_degree: Annotated[
        int, typer.Option(help="Degree of the background's polynomial; 8 for stray light.")
    ] = 4,
    max_chi_square: Annotated[float, typer.Option(help="Frames that fit worse are refused.")] = 2.0,
    layer: Annotated[
        str | None, typer.Option(help="Layer of EXR files, array of npz, mat and HDF5 files.")
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="NetCDF file (.nc).")] = Path(
        "etalon.nc"
    ),
    overwrite: Overwrite = False,
) -> None:
    """Calibrate an etalon from frames of its laser: focal length, tilt, distortion, finesse, light.

    Frames of a second known line (--line) give the gap, too.

    Writes the calibration (NetCDF) and, beside it, a figure of the misfit (PNG).
    """
    from lidar_mi import __version__
    from lidar_mi.assessment.figures.calibration import draw_calibration
    from lidar_mi.experiment.ring_frames import calibrate_etalon, doppler_of, read_electrons
    from lidar_mi.io.netcdf import write_netcdf
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.checks import identical
    from lidar_mi.schema.reading import load
    from lidar_mi.schema.shipped import experiment_file

    figure = out.with_suffix(".png")
    lamps = _lines(line or [])
    inputs = [*frames, *(flat or []), *(path for paths in lamps.values() for path in paths)]
    check_target(out, inputs, overwrite=overwrite, suffixes=(".nc",))
    check_target(figure, inputs, overwrite=overwrite)
    experiment = load(experiment_file(instrument), list(changes or []))
    ccd, counts = doppler_of(experiment, "--instrument").ccd, not electrons
    values = read_electrons(frames, ccd, counts=counts, layer=layer)
    if same := identical(values, "frames", start=0):
        output.print(f"warning: {same}")
    white = None
    if flat:
        white = read_electrons(flat, ccd, counts=counts, layer=layer).mean(0)
    fit = calibrate_etalon(
        values,
        experiment,
        flat=white,
        lines={
            wavelength: read_electrons(paths, ccd, counts=counts, layer=layer)
            for wavelength, paths in lamps.items()
        },
        gap_tolerance=quantity("--gap-tolerance", gap_tolerance, "m", "10 um"),
        wavelength_accuracy=wavelength_accuracy,
        achromatic=not chromatic,
        light_degree=light_degree,
        background_degree=background_degree,
        max_chi_square=max_chi_square,
    )
    write_netcdf(fit.to_dataset().assign_attrs(software=f"lidar-mi {__version__}"), out)
    write_png(draw_calibration(fit), figure)
    for table in fit.tables():
        print_table(table)
    output.print(f"calibration {out}")
    output.print(f"figure      {figure}")


def _lines(texts: list[str]) -> dict[float, list[Path]]:
    """Files by the wavelength (m) of their line."""
    files: dict[float, list[Path]] = {}
    for text in texts:
        wavelength, equals, path = text.partition("=")
        if not (equals and path):
            raise InputError(
                f"--line: {text!r} is not allowed; expected WAVELENGTH=FILE, such as "
                "'404.7708 nm=lamp.tif'"
            )
        files.setdefault(quantity("--line", wavelength, "m", "404.7708 nm"), []).append(Path(path))
    return files
