"""``lidar-mi retrieve``: the cross-flow wind in images of the same air."""

import enum
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_mi.cli.exit_codes import end_without_result
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

_SAME = 1e-3
"""Relative difference between a time step given and one from headers that is rounding."""


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
    import numpy as np
    import xarray as xr

    from lidar_mi import __version__
    from lidar_mi.io.images import read_beams, read_images, read_noise
    from lidar_mi.io.target import check_target
    from lidar_mi.io.wind_file import SERIES, SUFFIXES, write_wind
    from lidar_mi.retrieval.images.common_grid import on_one_grid
    from lidar_mi.retrieval.images.gridding import on_nodes
    from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes
    from lidar_mi.retrieval.wind.pair import retrieve_wind
    from lidar_mi.retrieval.wind.pair_input import method_of
    from lidar_mi.retrieval.wind.series import retrieve_winds
    from lidar_mi.retrieval.wind.synchronised import synchronised

    settings_of = method_of(method).options
    check_target(out, files, overwrite=overwrite, suffixes=SUFFIXES if pairs is None else SERIES)
    drawn = out.with_suffix(".png") if picture and pairs is None else None
    if drawn is not None:
        check_target(drawn, files, overwrite=overwrite)
    if pixels and spacing is not None:
        raise InputError("--pixels, --spacing: both; expected one of them")
    spacing = 1.0 if pixels else spacing
    numbers = None if frame is None else _numbers(frame)
    layer = layer or _layer(files)
    asked = _frames(files, layer, numbers, pairs)
    paths = [path for path, frames in asked for _ in frames]
    chosen = None if pairs is None else _pairs(pairs, len(paths))
    more = len(paths) > 2 and chosen is None
    if more and "more" not in settings_of:
        raise InputError(
            f"{len(paths)} images are not allowed with --method {method}; expected two, --pairs "
            "all (a wind from each pair), or --method variational (one wind from all)"
        )
    images = [one for path, frames in asked for one in read_images(path, frames, layer, spacing)]
    per_frame = pixels and dt is None
    steps = [1.0] * (len(paths) - 1) if per_frame else _time_steps(paths, dt, equal=chosen is None)
    noisy = paths if chosen is not None else paths[:1]
    levels: list[Any] = [
        read_noise(path, layer, spacing) if noise is None else noise for path in noisy
    ]
    beams = [read_beams(path, spacing) for path in paths]
    scans: dict[int, xr.Dataset] = {}
    for number, when in enumerate(beams):
        if when is not None and "y_reported" in when:
            scans[number] = when.assign(image=images[number])
            level = levels[number] if number < len(levels) else None
            if isinstance(level, xr.DataArray):
                scans[number] = scans[number].assign(image_stderr=level)
    if scans:
        if len(scans) == len(paths):
            gridded = synchronised(list(scans.values()), steps, "image")
        else:
            gridded = [on_nodes(scan) for scan in scans.values()]
        for number, scan in zip(scans, gridded, strict=True):
            beams[number], images[number] = scan, scan["image"]
            level = levels[number] if number < len(levels) else None
            if isinstance(level, xr.DataArray):
                levels[number] = scan["image_stderr"]
                if "image_resampling_std" in scan:
                    added = scan["image_resampling_std"].fillna(0.0)
                    levels[number] = (levels[number] ** 2 + added**2) ** 0.5
    seen = [when["beam_time"] for when in beams if when is not None and not when.frozen_air]
    timed = len(seen) == len(paths)
    options: dict[str, Any] = {
        "method": method,
        "windows": WindowSizes(template, search, stride),
        "validation": VectorValidation(min_correlation, min_texture, min_isotropy),
        "device": device,
    }
    grid = images[0]
    if chosen is not None:
        with progress() as notice:
            wind = retrieve_winds(
                images,
                steps,
                chosen,
                beam_times=seen if timed else None,
                notice=notice,
                noise=levels,
                **options,
            )
    else:
        grid, _ = pair = on_one_grid(*images[:2])
        level = levels[0]
        if isinstance(level, xr.DataArray) and pair[0] is not images[0]:
            # noise cannot be interpolated: its median is used
            level = float(level.median())
        with progress() as notice:
            notice(f"{method}: {grid.sizes['y']} x {grid.sizes['z']} pixels", None)
            wind = retrieve_wind(
                *pair,
                dt=steps[0],
                noise=level,
                more=images[2:],
                times=on_one_grid(*seen[:2]) if timed else None,
                **options,
            )
    if pixels:
        wind = _in_pixels(wind, per_frame=per_frame)
    z, y = (float(np.diff(grid[axis].values).mean()) for axis in "zy")
    wind = wind.assign_attrs(software=f"lidar-mi {__version__}")
    lost = write_wind(out, wind, (z, y))
    if chosen is not None:
        _print_series(wind)
    else:
        _print_wind(wind)
    output.print(f"method   {method}")
    output.print(f"winds    {out}")
    if drawn is not None:
        _draw(wind, drawn, colours.value, lines.value)
        output.print(f"picture  {drawn}")
    if lost:
        output.print(f"lost     {lost}; .nc has them", soft_wrap=True)
    if not (wind["flag"] == 0).any():
        end_without_result(f"no valid vector of {wind['flag'].size}", wind["flag"])


def _in_pixels(wind: "xr.Dataset", *, per_frame: bool) -> "xr.Dataset":
    """The same numbers, of pixels of 1 m, with their units; ``per_frame``: and of frames of 1 s."""
    wind = wind.copy()
    for variable in wind.variables.values():
        if "units" in variable.attrs:
            unit = re.sub(r"\bm(?=-?\d|\b)", "px", str(variable.attrs["units"]))
            if per_frame:
                unit = re.sub(r"\bs(?=-?\d|\b)", "frame", unit)
            variable.attrs["units"] = unit
    return wind.assign_attrs(dt_units="frame") if per_frame else wind


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


def _frames(
    files: Sequence[Path], layer: str | None, numbers: list[int] | None, pairs: str | None
) -> list[tuple[Path, Sequence[int]]]:
    """Which frames of which files are meant; what is ambiguous is refused with the choices."""
    from lidar_mi.io.images import frames_in

    if len(files) == 1:
        return [(files[0], _of_one_file(files[0], layer, numbers, pairs))]
    if numbers is None:
        for path in files:
            count, _ = frames_in(path, layer)
            if count > 1:
                shown = ",".join("0" for _ in files[:4])
                raise InputError(
                    f"{path}: {count} frames; expected --frame with a number for each file, such "
                    f"as {shown}, or this file alone"
                )
        numbers = [0]
    if len(numbers) not in (1, len(files)):
        raise InputError(
            f"--frame: {len(numbers)} numbers are not allowed with {len(files)} files; expected "
            f"one, or {len(files)}"
        )
    each = numbers * len(files) if len(numbers) == 1 else numbers
    return [(path, [number]) for path, number in zip(files, each, strict=True)]


def _of_one_file(
    path: Path, layer: str | None, numbers: list[int] | None, pairs: str | None
) -> Sequence[int]:
    from lidar_mi.io.images import frames_in

    if numbers is not None:
        if pairs is not None:
            raise InputError("--frame, --pairs: both with one file; expected one of them")
        if len(numbers) < 2:
            raise InputError(f"--frame: one frame of {path}; expected two, such as 0,1")
        return numbers
    count, channels = frames_in(path, layer)
    if count == 1:
        raise InputError(f"{path}: one image; expected two files, or a file of two frames")
    if channels:
        raise InputError(
            f"{path}: {count} channels of one moment by what the file says; expected --frame 0,1 "
            "to take two as images one after the other"
        )
    if count > 2 and pairs is None:
        raise InputError(
            f"{path}: {count} frames; expected --frame with two of them, such as 0,1, or --pairs "
            "all (a wind from each with the next)"
        )
    return range(count)


def _pairs(text: str, count: int) -> list[tuple[int, int]]:
    """The pairs of images that --pairs names; whether they exist is for the retrieval to say."""
    if text.strip() == "all":
        return list(pairwise(range(count)))
    found = []
    for part in text.split(","):
        numbers = [number.strip() for number in part.split("-")]
        if len(numbers) != 2 or not all(n.isascii() and n.isdigit() for n in numbers):
            raise InputError(
                f"--pairs: {part.strip()!r} is not allowed; expected all, or pairs of numbers "
                "such as 0-1,1-2"
            )
        found.append((int(numbers[0]), int(numbers[1])))
    return found


def _layer(paths: Sequence[Path]) -> str | None:
    """The layer that all files have by default, said; None: they have no names of layers."""
    from lidar_mi.io.images import default_layer

    found = {path: default_layer(path) for path in paths}
    names = set(found.values())
    if "Y_noisy" in names and len(names) > 1:
        other = next(path for path, name in found.items() if name != "Y_noisy")
        raise InputError(
            f"{other}: without the layer Y_noisy, which other images have; expected --layer, such "
            "as --layer Y for all"
        )
    (name,) = names if len(names) == 1 else (None,)
    if name == "Y_noisy":
        output.print("layer    Y_noisy, with the detector's noise (--layer Y: without it)")
    elif name:
        output.print(f"layer    {name}")
    return name


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


def _time_steps(paths: Sequence[Path], given: float | None, *, equal: bool) -> list[float]:
    """From each image to the next as given, else from the files; contradictions are said."""
    from lidar_mi.io.image_times import steps_of

    stated = steps_of(paths)
    count = len(paths) - 1
    if stated is None:
        if given is None:
            raise InputError("--dt: missing, and the files do not say it; expected seconds")
        return [given] * count
    said = ", ".join(f"{step:g}" for step in dict.fromkeys(stated))
    unequal = any(abs(step - stated[0]) > _SAME * abs(stated[0]) for step in stated)
    if given is not None:
        if min(stated) <= 0:
            output.print(
                f"warning: by their headers ({said} s) an image is not later than the one before: "
                "v and w have the opposite sign if the images are swapped"
            )
        elif unequal or abs(given - stated[0]) > _SAME * stated[0]:
            output.print(f"warning: --dt {given:g} s, but {said} s by the headers of the files")
        return [given] * count
    if min(stated) <= 0:
        raise InputError(
            f"{paths[0]}: {said} s to the next image by the headers; expected images in the order "
            "of their times, or --dt"
        )
    if unequal and equal:
        raise InputError(f"--dt: {said} s by the headers; expected images of equal steps, or --dt")
    output.print(f"dt       {said if unequal else f'{stated[0]:g}'} s, by the headers of the files")
    return stated


def _statistics(wind: "xr.Dataset", form: str = ".3g") -> tuple[float, list[tuple[str, str, str]]]:
    """Fraction of valid vectors; their mean, rms and mean stated error of v and of w."""
    import numpy as np

    valid = wind["flag"] == 0
    columns = []
    for name in ("v", "w"):
        values = wind[name].where(valid)
        error = wind[f"{name}_stderr"].where(valid) if f"{name}_stderr" in wind else values * np.nan
        found = (values.mean(), np.sqrt((values**2).mean()), error.mean())
        mean, rms, stated = ("-" if np.isnan(one) else f"{float(one):{form}}" for one in found)
        columns.append((mean, rms, stated))
    return float(valid.mean()), columns


def _print_statistics(wind: "xr.Dataset") -> None:
    """How many vectors are valid, and their statistics."""
    valid, columns = _statistics(wind)
    rows = list(zip(("mean", "rms", "mean stated error"), *columns, strict=True))
    title = f"{wind.sizes['y']} x {wind.sizes['z']} vectors, {valid:.1%} valid"
    unit = _speed(wind)
    print_table(Table(title, rows, ("valid vectors", f"v, {unit}", f"w, {unit}")))


def _speed(wind: "xr.Dataset") -> str:
    """The unit of v as one writes it: m/s, px/s or px/frame."""
    return re.sub(r" (\w+)-1", r"/\1", str(wind["v"].attrs["units"]))


def _print_series(winds: "xr.Dataset") -> None:
    """The statistics of each pair, a row each, and what was remarked on it."""
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
