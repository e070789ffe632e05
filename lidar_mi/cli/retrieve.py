"""``lidar-mi retrieve``: the cross-flow wind in images of the same air."""

import enum
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from lidar_mi.cli.exit_codes import end_without_result, flags_in_words
from lidar_mi.cli.options import Overwrite, complete_method
from lidar_mi.cli.terminal import output, print_rows, print_table
from lidar_mi.errors import InputError
from lidar_mi.progress import progress
from lidar_mi.tables import Table

if TYPE_CHECKING:
    import xarray as xr

EXAMPLES = (
    "lidar-mi retrieve image_t1.exr image_t2.exr --dt 0.1 -o wind.nc",
    "lidar-mi retrieve frame_*.tif --dt 0.1 --spacing 0.5 --pairs all",
    "lidar-mi retrieve stack.tif --frame 3,4 --dt 0.1 --spacing 0.5 -o wind.csv",
    "lidar-mi retrieve a.png b.png --pixels -o motion.nc",
)


class Colours(enum.StrEnum):
    """Of a picture of a wind."""

    SPEED = "speed"
    VORTICITY = "vorticity"


class Lines(enum.StrEnum):
    """On a picture of a wind."""

    ARROWS = "arrows"
    STREAMLINES = "streamlines"


def retrieve(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Images at t1 and t2: EXR, TIFF, PNG, BMP, JPEG, FITS, PGM, npy, mat, HDF5, ...; "
            "or one file that holds both, such as a TIFF of two pages. Further images, each dt "
            "after the one before: of a burst (variational), or of a sequence (--pairs)."
        ),
    ],
    *,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Numbers of the frames, from 0, of files that hold several: two of one file, such "
            "as 0,1 (more: a burst), or one for each file."
        ),
    ] = None,
    pairs: Annotated[
        str | None,
        typer.Option(
            help="A wind from each pair: all (each image with the next), or numbers from 0 such "
            "as 0-1,1-2,3-5."
        ),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(help="Time between the images, s. Default: what the files of a run say."),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            "-o",
            "--out",
            help="File of the winds: .nc (NetCDF), .csv, .mat (MATLAB), .vtk or .vti (VTK), .flo "
            "(Middlebury: displacements in pixels alone).",
        ),
    ] = Path("wind.nc"),
    method: Annotated[
        str,
        typer.Option(
            help="variational (a smooth flow), cc (cross-correlation), ws (weight shift), "
            "multipass or vortex_fit.",
            autocompletion=complete_method,
        ),
    ] = "variational",
    template: Annotated[int, typer.Option(help="Template size, pixels.")] = 8,
    search: Annotated[int, typer.Option(help="Search region, pixels.")] = 16,
    stride: Annotated[int, typer.Option(help="Step between vectors, pixels.")] = 1,
    layer: Annotated[
        str | None,
        typer.Option(
            help="Layer of the EXR files, array of npz, mat and HDF5 files. Default: Y_noisy (with "
            "the detector's noise), else Y, or the only one."
        ),
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Pixel spacing in m, for files without axes.")
    ] = None,
    pixels: Annotated[
        bool,
        typer.Option(
            "--pixels",
            help="Places and motion in pixels instead of metres, y and v to the left, z and w up; "
            "without --dt motion from frame to frame.",
        ),
    ] = False,
    picture: Annotated[
        bool,
        typer.Option(
            help="Draw the vectors of a wind into a PNG of the same name as the file (not with "
            "--pairs)."
        ),
    ] = True,
    colours: Annotated[
        Colours, typer.Option(help="Of the picture: speed or vorticity (dw/dy - dv/dz).")
    ] = Colours.SPEED,
    lines: Annotated[
        Lines, typer.Option(help="On the picture: arrows or streamlines.")
    ] = Lines.ARROWS,
    noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of the images' noise. Default: what our EXR "
            "files say, else estimated.",
        ),
    ] = None,
    min_correlation: Annotated[
        float, typer.Option(help="Vectors with a lower correlation are flagged (not ws).")
    ] = 0.5,
    min_texture: Annotated[
        float, typer.Option(help="Rms slope relative to the mean, per pixel; below: flagged.")
    ] = 0.01,
    min_isotropy: Annotated[
        float, typer.Option(help="Weakest over strongest slope; below: flagged.")
    ] = 0.2,
    device: Annotated[str, typer.Option(help="That computes: cpu, cuda, or auto.")] = "cpu",
    overwrite: Overwrite = False,
) -> None:
    """Retrieve the cross-flow wind (v, w) from any two images of the same air, or from many.

    Exit code 1: no vector is valid; the file says why.
    """
    from lidar_mi import __version__
    from lidar_mi.experiment.image_files import retrieve_files
    from lidar_mi.io.target import check_target
    from lidar_mi.io.wind_file import SERIES, SUFFIXES, write_wind
    from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes
    from lidar_mi.retrieval.wind.pair_input import method_of

    method_of(method)
    check_target(out, files, overwrite=overwrite, suffixes=SUFFIXES if pairs is None else SERIES)
    drawn = out.with_suffix(".png") if picture and pairs is None else None
    if drawn is not None:
        check_target(drawn, files, overwrite=overwrite)
    with progress() as notice:
        wind = retrieve_files(
            files,
            dt=dt,
            frame=None if frame is None else _numbers(frame),
            pairs=None if pairs is None else _pairs(pairs),
            layer=layer,
            spacing=spacing,
            pixels=pixels,
            noise=noise,
            notice=notice,
            method=method,
            windows=WindowSizes(template, search, stride),
            validation=VectorValidation(min_correlation, min_texture, min_isotropy),
            device=device,
        )
    wind = wind.assign_attrs(software=f"lidar-mi {__version__}")
    omitted = write_wind(out, wind, wind.attrs["pixel_size"])
    _print_file_remarks(wind, by_default=layer is None, from_headers=dt is None and not pixels)
    if pairs is not None:
        _print_series(wind)
    else:
        _print_wind(wind)
    output.print(f"method   {method}")
    output.print(f"winds    {out}")
    if drawn is not None:
        _draw(wind, drawn, colours.value, lines.value)
        output.print(f"picture  {drawn}")
    if omitted:
        output.print(f"lost     {omitted}; .nc has them", soft_wrap=True)
    if not (wind["flag"] == 0).any():
        end_without_result(f"no valid vector of {wind['flag'].size}", wind["flag"])


def _draw(wind: "xr.Dataset", path: Path, colours: str, lines: str) -> None:
    from matplotlib.figure import Figure

    from lidar_mi.io.png import write_png
    from lidar_mi.plots import plot_wind

    figure = Figure(figsize=(7.5, 4.6), layout="compressed")
    plot_wind(wind, figure.subplots(), colours=colours, lines=lines)
    write_png(figure, path)


def _numbers(text: str) -> list[int]:
    """Frames that --frame names."""
    numbers = [part.strip() for part in text.split(",")]
    if not all(number.isascii() and number.isdigit() and len(number) < 10 for number in numbers):
        raise InputError(
            f"--frame: {text[:50]!r} is not allowed; expected numbers from 0, such as 0,1"
        )
    return [int(number) for number in numbers]


def _pairs(text: str) -> list[tuple[int, int]] | Literal["all"]:
    """The pairs of images that --pairs names; the retrieval checks that they exist."""
    if text.strip() == "all":
        return "all"
    pairs = []
    for part in text.split(","):
        numbers = [number.strip() for number in part.split("-")]
        if len(numbers) != 2 or not all(n.isascii() and n.isdigit() for n in numbers):
            raise InputError(
                f"--pairs: {part.strip()!r} is not allowed; expected all, or pairs of numbers "
                "such as 0-1,1-2"
            )
        pairs.append((int(numbers[0]), int(numbers[1])))
    return pairs


def _print_file_remarks(wind: "xr.Dataset", *, by_default: bool, from_headers: bool) -> None:
    """Layer, time step and remarks from the files."""
    layer = wind.attrs["layer"]
    if layer and by_default:
        noisy = ", with the detector's noise (--layer Y: without it)" if layer == "Y_noisy" else ""
        output.print(f"layer    {layer}{noisy}")
    if from_headers:
        steps = wind["dt"].values.ravel() if "dt" in wind else [wind.attrs["dt"]]
        times = ", ".join(dict.fromkeys(f"{step:g}" for step in steps))
        output.print(f"dt       {times} s, by the headers of the files")
    for remark in wind.attrs["remarks"].splitlines():
        output.print(f"warning: {remark}")


def _print_wind(wind: "xr.Dataset") -> None:
    """What was retrieved from two images or from a burst."""
    if "fit" in wind.attrs:
        _print_vortices(wind)
    if "identical_images" in wind.attrs:
        output.print(f"warning: {wind.attrs['identical_images']}: they show no motion")
    if "defects" in wind.attrs:
        output.print(f"warning: {wind.attrs['defects']}")
    if "fixed_pattern" in wind.attrs:
        output.print(f"warning: {wind.attrs['fixed_pattern']} in all images")
    if "illumination" in wind.attrs:
        output.print(f"warning: {wind.attrs['illumination']} between the images")
    _print_statistics(wind)


def _statistics(wind: "xr.Dataset", form: str = ".3g") -> tuple[float, list[tuple[str, str, str]]]:
    """Fraction of valid vectors; their mean, rms and mean stated error of v and of w."""
    import numpy as np

    valid = wind["flag"] == 0
    columns = []
    for name in ("v", "w"):
        values = wind[name].where(valid)
        error = wind[f"{name}_stderr"].where(valid) if f"{name}_stderr" in wind else values * np.nan
        statistics = (values.mean(), np.sqrt((values**2).mean()), error.mean())
        mean, rms, stderr = ("-" if np.isnan(x) else f"{float(x):{form}}" for x in statistics)
        columns.append((mean, rms, stderr))
    return float(valid.mean()), columns


def _print_statistics(wind: "xr.Dataset") -> None:
    """How many vectors are valid, and their statistics."""
    valid, columns = _statistics(wind)
    rows = list(zip(("mean", "rms", "mean stated error"), *columns, strict=True))
    title = f"{wind.sizes['y']} x {wind.sizes['z']} vectors, {valid:.1%} valid"
    unit = _speed(wind)
    print_table(Table(title, rows, ("valid vectors", f"v, {unit}", f"w, {unit}")))
    if flags := flags_in_words(wind["flag"]):
        output.print(f"flags    {flags}", soft_wrap=True)


def _speed(wind: "xr.Dataset") -> str:
    """The unit of v: m/s, px/s or px/frame."""
    return re.sub(r" (\w+)-1", r"/\1", str(wind["v"].attrs["units"]))


def _print_series(winds: "xr.Dataset") -> None:
    """Statistics and remarks of each pair, a row each."""
    rows = []
    for number in range(winds.sizes["time"]):
        wind = winds.isel(time=number)
        name = f"{int(wind['first_image'])}-{int(wind['second_image'])}"
        if remark := str(wind["remark"].values):
            output.print(f"warning: images {name}: {remark}", soft_wrap=True)
        valid, columns = _statistics(wind, ".3f")
        numbers = (part for column in columns for part in column)
        rows.append((name, f"{float(wind['time']):.5g}", f"{valid:.0%}", *numbers))
    heads = (
        "images",
        f"time, {winds['time'].attrs['units']}",
        "valid",
        "v: mean",
        "rms",
        "error",
        "w: mean",
        "rms",
        "error",
    )
    title = f"{winds.sizes['y']} x {winds.sizes['z']} vectors a pair"
    note = f"mean, rms and mean stated error of the valid vectors, {_speed(winds)}"
    print_table(Table(title, rows, heads, note))


def _print_vortices(wind: "xr.Dataset") -> None:
    """The numbers of a fitted vortex pair with their standard errors."""
    rows = []
    for name in (n for n in wind.data_vars if f"{n}_stderr" in wind and not wind[n].dims):
        value, stderr = float(wind[name]), float(wind[f"{name}_stderr"])
        rows.append((str(name), f"{value:.2f} +- {stderr:.2f} {wind[name].attrs['units']}"))
    print_rows(
        f"vortex pair, {wind.attrs['profile'].replace('_', ' ')} ({wind.attrs['fit']})", rows
    )
