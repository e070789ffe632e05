"""``lidar-mi rings``: the rings of an etalon in any image."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Overwrite
from lidar_mi.cli.terminal import output, print_table
from lidar_mi.errors import InputError

EXAMPLES = (
    "Examples: `lidar-mi rings fringes.png` - `lidar-mi rings frame.exr --layer Y "
    "--centre 479.5 389.5 -o frame_rings.png`"
)


def rings(
    image: Annotated[Path, typer.Argument(help="EXR, PNG, TIFF, BMP, JPEG or FITS image.")],
    centre: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Centre of the rings, if known: x to the right, y down, pixels from "
            "the middle of the top left one. Default: fitted."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Image (PNG). Default: IMAGE_rings.png.")
    ] = None,
    layer: Annotated[
        str | None, typer.Option(help="Layer of an EXR file. Default: Y, or the only one.")
    ] = None,
    saturation: Annotated[
        float | None, typer.Option(help="Value from which a pixel is saturated.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the rings of an etalon in any image: centre, radii, orders, quality of the fit."""
    from lidar_mi.assessment.figures.rings import draw_rings
    from lidar_mi.io.images import read_pixels
    from lidar_mi.io.png import write_png
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.rings.analysis import analyse_rings

    path = out or Path(f"{image.stem}_rings.png")
    check_target(path, [image], overwrite=overwrite)
    values = read_pixels(image, layer)
    try:
        found = analyse_rings(values, centre, saturation)
    except InputError as error:
        raise InputError(f"{image}: {error}") from None
    figure = draw_rings(values, found, image.name)
    write_png(figure, path)
    for table in found.tables():
        print_table(table)
    output.print(f"image    {path}")
