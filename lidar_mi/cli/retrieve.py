"""``lidar-mi retrieve``: the cross-flow wind in images of the same air."""

from pathlib import Path
from typing import Annotated, Any

import typer

from lidar_mi.cli.options import Overwrite
from lidar_mi.cli.terminal import output, print_rows

EXAMPLES = "Example: `lidar-mi retrieve image_t1.exr image_t2.exr --dt 0.1 -o wind.nc`"


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
    dt: Annotated[float, typer.Option(help="Time between the images, s.")],
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
    device: Annotated[str, typer.Option(help="torch device, such as cpu or cuda.")] = "cpu",
    overwrite: Overwrite = False,
) -> None:
    """Retrieve the cross-flow wind (v, w) from any two images of the same air."""
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
        dt=dt,
        method=method,
        template=template,
        search=search,
        stride=stride,
        device=device,
        noise=level,
        more=images[2:],
        times=times,
    )
    write_netcdf(wind.assign_attrs(software=f"lidar-mi {__version__}"), out)
    valid = float((wind["flag"] == 0).mean())
    if "fit" in wind.attrs:
        _print_vortices(wind)
    if "fixed_pattern" in wind.attrs:
        output.print(f"warning: {wind.attrs['fixed_pattern']} in all images")
    if "illumination" in wind.attrs:
        output.print(f"warning: {wind.attrs['illumination']} between the images")
    output.print(f"{wind.sizes['y']} x {wind.sizes['z']} vectors, {valid:.1%} valid")
    output.print(f"winds    {out}")


def _print_vortices(wind) -> None:
    """The numbers of a fitted vortex pair with their standard errors."""
    rows = []
    for name in (n for n in wind.data_vars if f"{n}_stderr" in wind and not wind[n].dims):
        value, stderr = float(wind[name]), float(wind[f"{name}_stderr"])
        rows.append((name, f"{value:.2f} +- {stderr:.2f} {wind[name].attrs['units']}"))
    print_rows(
        f"vortex pair, {wind.attrs['profile'].replace('_', ' ')} ({wind.attrs['fit']})", rows
    )
