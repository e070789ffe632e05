"""``lidar-mi rings``: the rings of an etalon in any image, or in a series of them."""

import csv
import functools
import io
import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar_mi.cli.options import Overwrite, quantity
from lidar_mi.cli.terminal import output, print_table
from lidar_mi.errors import InputError

if TYPE_CHECKING:
    import numpy as np

EXAMPLES = (
    "lidar-mi rings fringes.png",
    "lidar-mi rings frame.exr --layer Y --centre 479.5 389.5 -o frame_rings.png",
    "lidar-mi rings cube.fits --all -o series.csv",
    'lidar-mi rings lamp.tif --wavelength "487.986 nm" "487.873 nm" --gap "0.9 mm" "0.1 mm"',
)


def rings(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Image of any kind (EXR, PNG, TIFF, BMP, JPEG, FITS, PGM, npy, mat, HDF5, ...), a "
            "TIFF of several pages, a cube, or several files of one instrument."
        ),
    ],
    frame: Annotated[
        int | None, typer.Option(help="Number of the frame that is measured, from 0.")
    ] = None,
    average: Annotated[
        bool, typer.Option("--average", help="Measure the mean of all frames.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", help="Measure every frame; -o writes a table (CSV).")
    ] = False,
    centre: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Centre of the rings, if known: x to the right, y down, pixels from "
            "the middle of the top left one. Default: fitted."
        ),
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Step of r^2 from order to order, px^2, if known to 2 %.")
    ] = None,
    wavelength: Annotated[
        tuple[str, str] | None,
        typer.Option(help="Of two lines, the brighter one's first: gives the etalon's gap."),
    ] = None,
    gap: Annotated[
        tuple[str, str] | None,
        typer.Option(help="Nominal gap and its tolerance, where two lines allow several."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Image (PNG). Default: IMAGE_rings.png; a table: none."),
    ] = None,
    layer: Annotated[
        str | None,
        typer.Option(
            help="Layer of an EXR file, array of an npz, mat or HDF5 file. Default: Y, or the only "
            "one."
        ),
    ] = None,
    saturation: Annotated[
        float | None, typer.Option(help="Value from which a pixel is saturated.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the rings of an etalon in any image: centre, radii, orders, quality of the fit."""
    from lidar_mi.assessment.figures.rings import draw_rings
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.rings.analysis import analyse_rings
    from lidar_mi.retrieval.rings.gap import gap_from_lines

    if (frame is not None) + average + every > 1:
        raise InputError("--frame, --average, --all: more than one; expected one of them")
    if gap is not None and wavelength is None:
        raise InputError("--gap: without --wavelength; expected both, or neither")
    if wavelength is not None and every:
        raise InputError("--wavelength: not allowed with --all; expected --frame or --average")
    lines = [quantity("--wavelength", text, "m", "487.986 nm") for text in wavelength or ()]
    expected = [quantity("--gap", text, "m", "0.9 mm") for text in gap or ()]
    if every:
        _series(images, layer, (centre, saturation, spacing), out, overwrite)
        return
    path = out or Path(f"{images[0].stem}_rings.png")
    check_target(path, images, overwrite=overwrite, suffixes=(".png",))
    values = _chosen_frame(images, layer, frame, average, saturation)
    name = images[0] if len(images) == 1 else f"{images[0]} to {images[-1]}"
    try:
        analysis = analyse_rings(values, centre, saturation if not average else None, spacing)
        etalon = gap_from_lines(analysis, lines, *expected) if lines else None
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    write_png(draw_rings(values, analysis, images[0].name), path)
    for table in analysis.tables() + (etalon.tables() if etalon else []):
        print_table(table)
    output.print(f"image    {path}")


def _frames(images: list[Path], layer: str | None) -> Iterator[tuple[str, "np.ndarray"]]:
    """Every frame of the files, each with its name; refused if their sizes differ."""
    from lidar_mi.io.images import read_frames

    first = None
    for path in images:
        for number, frame in enumerate(read_frames(path, layer)):
            first = first or frame.shape
            if frame.shape != first:
                raise InputError(
                    f"{path}: {frame.shape[1]} x {frame.shape[0]} px; expected {first[1]} x "
                    f"{first[0]} px as of {images[0]}"
                )
            yield f"{path}[{number}]", frame.astype(float)


def _chosen_frame(
    images: list[Path],
    layer: str | None,
    frame: int | None,
    average: bool,
    saturation: float | None,
) -> "np.ndarray":
    """The frame with the number, or the mean of all."""
    import torch

    from lidar_mi.io.images import frames_in, read_frames
    from lidar_mi.retrieval.rings.frames import checked

    if average:
        frames = list(_frames(images, layer))
        for name, pixels in frames:
            try:
                checked(torch.from_numpy(pixels), saturation)
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        _remark([pixels for _, pixels in frames])
        return functools.reduce(operator.add, (pixels for _, pixels in frames)) / len(frames)
    places = [(path, n) for path in images for n in range(frames_in(path, layer)[0])]
    if frame is None and len(places) > 1:
        raise InputError(
            f"{images[0]}: {len(places)} frames; expected --frame N, --average or --all"
        )
    number = frame or 0
    if not 0 <= number < len(places):
        raise InputError(
            f"--frame: {number} is not allowed; expected 0 to {len(places) - 1} of {images[0]}"
        )
    path, within = places[number]
    return read_frames(path, layer, [within])[0].astype(float)


def _remark(frames: Sequence["np.ndarray"]) -> None:
    """Warn of identical frames."""
    from lidar_mi.retrieval.checks import identical

    if same := identical(frames, "frames", start=0):
        output.print(f"warning: {same}")


def _series(
    images: list[Path],
    layer: str | None,
    options: tuple[tuple[float, float] | None, float | None, float | None],
    out: Path | None,
    overwrite: bool,
) -> None:
    from lidar_mi import __version__
    from lidar_mi.io.target import check_target
    from lidar_mi.io.text import write_text
    from lidar_mi.retrieval.rings.series import analyse_series

    if out is not None:
        if out.suffix.lower() != ".csv":
            raise InputError(f"{out}: a table of frames; expected a name that ends in .csv")
        check_target(out, images, overwrite=overwrite)
    names, frames = zip(*_frames(images, layer), strict=True)
    _remark(frames)
    series = analyse_series(frames, *options)
    if not any(series.rings):
        raise InputError(f"{names[0]}: {series.refused[0]}; no frame has rings that are measured")
    for table in series.tables():
        print_table(table)
    if out is None:
        return
    columns = {"file": list(names), **series.columns()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_text(out, f"# software: lidar-mi {__version__}\n{text.getvalue()}")
    output.print(f"table    {out}")
