"""``lidar-mi retrieve``: the cross-flow wind in images of the same air."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_mi.cli.options import Overwrite
from lidar_mi.cli.terminal import output, print_rows, print_table
from lidar_mi.errors import InputError
from lidar_mi.tables import Table

if TYPE_CHECKING:
    import xarray as xr

EXAMPLES = "Example: `lidar-mi retrieve image_t1.exr image_t2.exr --dt 0.1 -o wind.nc`"

_SAME = 1e-3
"""Relative difference between a time step given and one from headers that is rounding."""


def retrieve(
    first: Annotated[Path, typer.Argument(help="Image at t1: EXR, TIFF, PNG, BMP, JPEG or FITS.")],
    second: Annotated[Path, typer.Argument(help="Image at t2.")],
    *,
    more: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Further images of a burst, each dt after the one before (variational)."
        ),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(help="Time between the images, s. Default: what the files of a run say."),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="NetCDF file.")] = Path("wind.nc"),
    method: Annotated[
        str,
        typer.Option(
            help="cc (cross-correlation), ws (weight shift), multipass, variational or vortex_fit."
        ),
    ] = "cc",
    template: Annotated[int, typer.Option(help="Template size, pixels.")] = 8,
    search: Annotated[int, typer.Option(help="Search region, pixels.")] = 16,
    stride: Annotated[int, typer.Option(help="Step between vectors, pixels.")] = 1,
    layer: Annotated[
        str | None, typer.Option(help="Layer of the EXR files. Default: Y, or the only one.")
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Pixel spacing in m, for files without axes.")
    ] = None,
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
    device: Annotated[str, typer.Option(help="torch device, such as cpu or cuda.")] = "cpu",
    overwrite: Overwrite = False,
) -> None:
    """Retrieve the cross-flow wind (v, w) from any two images of the same air, or from a burst."""
    import xarray as xr

    from lidar_mi import __version__
    from lidar_mi.io.images import read_beams, read_image, read_noise
    from lidar_mi.io.netcdf import write_netcdf
    from lidar_mi.io.target import check_target
    from lidar_mi.retrieval.velocimetry.common_grid import on_one_grid
    from lidar_mi.retrieval.velocimetry.gridding import on_nodes
    from lidar_mi.retrieval.velocimetry.wind import retrieve_wind

    paths = (first, second, *(more or []))
    check_target(out, paths, overwrite=overwrite)
    images = [read_image(path, layer, spacing) for path in paths]
    step = _time_step(paths, dt)
    level: Any = read_noise(first, layer, spacing) if noise is None else noise
    beams = [read_beams(path, spacing) for path in paths]
    for number, when in enumerate(beams):
        if when is not None and "y_reported" in when:
            scan = when.assign(image=images[number])
            if number == 0 and isinstance(level, xr.DataArray):
                scan = scan.assign(image_stderr=level)
            beams[number] = scan = on_nodes(scan)
            images[number] = scan["image"]
            level = scan.get("image_stderr", level)
    pair = on_one_grid(*images[:2])
    if isinstance(level, xr.DataArray) and pair[0] is not images[0]:
        # noise cannot be interpolated: its median is used
        level = float(level.median())
    seen = [when["beam_time"] for when in beams if when is not None and not when.frozen_air]
    times = on_one_grid(*seen[:2]) if len(seen) == len(paths) else None
    wind = retrieve_wind(
        *pair,
        dt=step,
        method=method,
        template=template,
        search=search,
        stride=stride,
        device=device,
        min_correlation=min_correlation,
        min_texture=min_texture,
        min_isotropy=min_isotropy,
        noise=level,
        more=images[2:],
        times=times,
    )
    write_netcdf(wind.assign_attrs(software=f"lidar-mi {__version__}"), out)
    if "fit" in wind.attrs:
        _print_vortices(wind)
    if "fixed_pattern" in wind.attrs:
        output.print(f"warning: {wind.attrs['fixed_pattern']} in all images")
    if "illumination" in wind.attrs:
        output.print(f"warning: {wind.attrs['illumination']} between the images")
    _print_winds(wind)
    output.print(f"winds    {out}")


def _time_step(paths: Sequence[Path], given: float | None) -> float:
    """The time between the images as given, else from the files; contradictions are said."""
    from lidar_mi.io.image_times import steps_of

    stated = steps_of(paths)
    if stated is None:
        if given is None:
            raise InputError("--dt: missing, and the files do not say it; expected seconds")
        return given
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
        return given
    if min(stated) <= 0:
        raise InputError(
            f"{paths[0]}: {said} s to the next image by the headers; expected images in the order "
            "of their times, or --dt"
        )
    if unequal:
        raise InputError(f"--dt: {said} s by the headers; expected images of equal steps, or --dt")
    output.print(f"dt       {stated[0]:g} s, by the headers of the files")
    return stated[0]


def _print_winds(wind: "xr.Dataset") -> None:
    """How many vectors are valid, and their statistics."""
    import numpy as np

    valid = wind["flag"] == 0
    columns = []
    for name in ("v", "w"):
        values = wind[name].where(valid)
        error = wind[f"{name}_stderr"].where(valid) if f"{name}_stderr" in wind else values * np.nan
        found = (values.mean(), np.sqrt((values**2).mean()), error.mean())
        columns.append(["-" if np.isnan(one) else f"{float(one):.3g}" for one in found])
    rows = list(zip(("mean", "rms", "mean stated error"), *columns, strict=True))
    title = f"{wind.sizes['y']} x {wind.sizes['z']} vectors, {float(valid.mean()):.1%} valid"
    print_table(Table(title, rows, ("valid vectors", "v, m/s", "w, m/s")))


def _print_vortices(wind) -> None:
    """The numbers of a fitted vortex pair with their standard errors."""
    rows = []
    for name in (n for n in wind.data_vars if f"{n}_stderr" in wind and not wind[n].dims):
        value, stderr = float(wind[name]), float(wind[f"{name}_stderr"])
        rows.append((name, f"{value:.2f} +- {stderr:.2f} {wind[name].attrs['units']}"))
    print_rows(
        f"vortex pair, {wind.attrs['profile'].replace('_', ' ')} ({wind.attrs['fit']})", rows
    )
