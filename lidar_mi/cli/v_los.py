"""``lidar-mi v_los``: line-of-sight speeds from frames of rings."""

import math
from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Changes, Electrons, NominalInstrument, Overwrite
from lidar_mi.cli.terminal import output, print_table
from lidar_mi.errors import InputError

EXAMPLES = (
    "lidar-mi v_los air_*.tif --reference laser.tif --calibration etalon.nc "
    "--instrument my_etalon.yaml",
    "lidar-mi v_los air.fits --calibration etalon.nc -o v.nc",
)


def v_los(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Frames of the echo of air: images of any kind, TIFF also of several pages, FITS "
            "and arrays also cubes."
        ),
    ] = None,
    signal: Annotated[
        list[Path] | None, typer.Option(help="The same by name, once per file.")
    ] = None,
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            help="Frames of the laser itself, once per file: one for all, or one for each frame."
        ),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="File of `lidar-mi calibrate`. Default: the nominal one.")
    ] = None,
    instrument: NominalInstrument = "fringes_paper",
    changes: Changes = None,
    electrons: Electrons = False,
    max_chi_square: Annotated[
        float | None,
        typer.Option(help="Frames that fit worse are refused. Default: doppler.retrieval's."),
    ] = None,
    layer: Annotated[
        str | None, typer.Option(help="Layer of EXR files, array of npz, mat and HDF5 files.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="NetCDF file (.nc). Default: none.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Retrieve the speed along the line of sight from every frame of an etalon's rings."""
    from lidar_mi.experiment.ring_frames import doppler_of, read_electrons, retrieve_v_los
    from lidar_mi.io.netcdf import read_netcdf, write_netcdf
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.checks import identical
    from lidar_mi.retrieval.rings.calibration import calibration_of
    from lidar_mi.schema.reading import load
    from lidar_mi.schema.shipped import experiment_file
    from lidar_mi.tables import Table, with_error

    frames = [*(frames or []), *(signal or [])]
    if not frames:
        raise InputError("frames: none is not allowed; expected files of the echo of air")
    inputs = [*frames, *(reference or []), *([calibration] if calibration else [])]
    if out is not None:
        check_target(out, inputs, overwrite=overwrite, suffixes=(".nc",))
    experiment = load(experiment_file(instrument), list(changes or []))
    ccd, counts = doppler_of(experiment, "--instrument").ccd, not electrons
    fit = None
    if calibration is not None:
        try:
            fit = calibration_of(read_netcdf(calibration))
        except InputError as error:
            raise InputError(f"{calibration}: {error}") from None
    air = read_electrons(frames, ccd, counts=counts, layer=layer)
    if same := identical(air, "frames", start=0):
        output.print(f"warning: {same}")
    laser = read_electrons(reference, ccd, counts=counts, layer=layer) if reference else None
    speeds = retrieve_v_los(air, laser, experiment, calibration=fit, max_chi_square=max_chi_square)
    rows: list[tuple[str, ...]] = []
    for k in range(speeds.sizes["frame"]):
        frame = speeds.isel(frame=k)
        speed, systematic = float(frame["v_los"]), float(frame["v_los_systematic"])
        rows.append(
            (
                str(k),
                with_error(speed, float(frame["v_los_std"])),
                "" if math.isnan(speed) else f"{systematic:.2g}",
                f"{float(frame['chi_square']):.3f}",
                str(frame["status"].values),
            )
        )
    refused = [row for row in rows if row[-1]]
    heads: tuple[str, ...] = ("frame", "v_los, m/s", "systematic", "chi-square", "refused")
    if not refused:
        rows, heads = [row[:-1] for row in rows], heads[:-1]
    note = "" if fit else "No calibration: the nominal instrument is taken as true."
    print_table(Table("line-of-sight speeds", rows, heads, note))
    if out is not None:
        write_netcdf(speeds, out)
        output.print(f"speeds   {out}")
    if len(refused) == len(rows):
        raise InputError("no frame has a speed; the reasons are in the table")
