"""``lidar-mi render``: a Mitsuba scene with the project's plugins."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Overwrite, Variant, complete_scene
from lidar_mi.cli.terminal import output
from lidar_mi.errors import InputError
from lidar_mi.progress import progress

EXAMPLES = ("lidar-mi render slab.xml -s 256 -D range=485 -o slab.exr",)


def render(
    scene: Annotated[
        str,
        typer.Argument(
            help="Mitsuba scene (XML), or the name of one of the package: slab.",
            autocompletion=complete_scene,
        ),
    ],
    variant: Variant = None,
    samples: Annotated[
        int,
        typer.Option(
            "-s", "--spp", min=0, help="Monte Carlo samples per beam; 0 = as in the scene."
        ),
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="EXR or PNG file; the other is written beside it. Default: beside the scene; of a "
            "shipped one, here.",
        ),
    ] = None,
    define: Annotated[
        list[str] | None,
        typer.Option("-D", "--define", metavar="KEY=VALUE", help="Fill in $KEY in the scene."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Render a Mitsuba scene of a `scanning_lidar` or a `ccd`, the plugins loaded.

    Pictures by other cameras: lidar_mi.register_plugins() and mi.render in Python. Writes an EXR,
    and beside it a PNG preview of its brightness, linear from black to white; the values of both
    are printed.
    """
    from lidar_mi.instrument.products import untrusted_pixels
    from lidar_mi.io.images import read_pixels
    from lidar_mi.io.png import write_preview
    from lidar_mi.io.target import check_target
    from lidar_mi.rendering.scene import files_of, render_file
    from lidar_mi.schema.shipped import scene_file

    source, definitions = scene_file(scene), _definitions(define or [])
    near = source if Path(scene).is_file() else Path(source.name)
    target, read = out or near.with_suffix(".exr"), files_of(source, definitions)
    check_target(target, read, overwrite=overwrite)
    path = _image(target)
    preview = path.with_suffix(".png")
    check_target(path, read, overwrite=overwrite)
    # made from the image: it is replaced together with it
    check_target(preview, read, overwrite=overwrite or path.exists())
    with progress() as notice:
        image = render_file(
            source,
            path,
            variant or "llvm_ad_mono_polarized",
            samples,
            seed,
            definitions,
            lambda fraction: notice(f"rendering {source.name}", fraction),
        )
    if warning := untrusted_pixels(image):
        output.print(f"warning: {warning}", soft_wrap=True)
    black, white = write_preview(preview, read_pixels(path))
    output.print(f"image    {path}")
    output.print(f"preview  {preview}: black is {black:.4g}, white {white:.4g}", soft_wrap=True)


def _image(out: Path) -> Path:
    """The EXR file of a name that is an EXR's, a PNG's or has no ending."""
    if out.suffix.lower() not in ("", ".exr", ".png"):
        raise InputError(f"-o {out}: {out.suffix} is not allowed; expected .exr or .png")
    return out if out.suffix.lower() == ".exr" else out.with_suffix(".exr")


def _definitions(texts: list[str]) -> dict[str, str]:
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise InputError(f"-D {text}: expected KEY=VALUE")
        pairs[key] = value
    return pairs
