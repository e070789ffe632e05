"""``lidar-mi aerosol``: the scattering table of an aerosol."""

from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Overwrite, quantity
from lidar_mi.cli.terminal import output, print_rows
from lidar_mi.errors import InputError
from lidar_mi.progress import progress

EXAMPLES = (
    "lidar-mi aerosol dust --wavelength '1064 nm'",
    "lidar-mi aerosol spheres --name smoke --index 1.6+0.02i --radius '0.1 um' --sigma 1.6 "
    "-o smoke.txt",
)


def aerosol(
    start: Annotated[
        str,
        typer.Argument(
            metavar="AEROSOL",
            help="The aerosol to start from: spheroids, spheres, continental, "
            "sea_salt, dust, droplets, soot.",
        ),
    ],
    wavelength: Annotated[str, typer.Option(help="Vacuum wavelength.")] = "532 nm",
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Table to write (.txt). Default: aerosol_NAME_NNNnm.txt."),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the new aerosol; needed if a parameter below is changed."),
    ] = None,
    index: Annotated[
        str | None,
        typer.Option(help="Refractive index, such as 1.53+0.008i; the imaginary part absorbs."),
    ] = None,
    elongation: Annotated[
        float | None,
        typer.Option(
            help="Length over width of prolate spheroids in random orientation; 1 = spheres."
        ),
    ] = None,
    radius: Annotated[
        str | None,
        typer.Option(
            help="Median radius of a log-normal, mode of a modified gamma distribution; of the "
            "sphere of equal volume, such as '0.2 um'."
        ),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(help="Geometric standard deviation of a log-normal distribution, above 1."),
    ] = None,
    smallest: Annotated[str | None, typer.Option(help="Smallest radius.")] = None,
    largest: Annotated[
        str | None,
        typer.Option(
            help="Largest radius. Time and memory grow steeply with it for spheroids; beyond a "
            "size parameter (circumference over wavelength) of about 24 they are refused."
        ),
    ] = None,
    number_density: Annotated[
        str | None,
        typer.Option(help="Number density of the table's particles, such as '2e8 / m^3'."),
    ] = None,
    nodes: Annotated[
        int | None,
        typer.Option(
            min=2, help="Sizes to average over. Default: 128 (spheroids), 10000 (spheres)."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute the scattering table of an aerosol: a named one, or one with changed parameters.

    The table holds the six elements of the scattering matrix over angle (T-matrix method for
    spheroids, Lorenz-Mie theory for spheres), averaged over sizes and orientations, and the
    extinction cross-section and albedo. A table of spheroids takes half a minute, of spheres a
    few seconds. In an experiment: `scattering: {phase: table,
    table: smoke.txt}`. Needs the library scatrs: `pip install 'lidar-mi[particles]'`.
    """
    from lidar_mi.atmosphere.scattering.aerosols import changed
    from lidar_mi.atmosphere.scattering.particle_scattering import make_table
    from lidar_mi.atmosphere.scattering.tables import describe
    from lidar_mi.io.scattering_table import write_table
    from lidar_mi.io.target import check_target

    metres = quantity("--wavelength", wavelength, "m", "532 nm")
    particles = changed(
        start,
        metres,
        name,
        index=_index(index),
        elongation=elongation,
        sigma=sigma,
        radius=quantity("--radius", radius, "m", "0.2 um"),
        smallest=quantity("--smallest", smallest, "m", "0.03 um"),
        largest=quantity("--largest", largest, "m", "1.5 um"),
        number_density=quantity("--number-density", number_density, "1/m^3", "2e8 / m^3"),
    )
    path = out or Path(f"aerosol_{particles.name}_{metres * 1e9:.0f}nm.txt")
    check_target(path, overwrite=overwrite, suffixes=(".txt",))
    with progress() as notice:
        table = make_table(particles, metres, nodes, notice)
    write_table(table, path)
    print_rows(particles.name, list(describe(table).items()))
    output.print(f"table    {path}")


def _index(text: str | None) -> complex | None:
    """A refractive index, its imaginary unit written as i or j."""
    try:
        return None if text is None else complex(text.replace(" ", "").replace("i", "j"))
    except ValueError:
        raise InputError(
            f"--index: {text!r} is not allowed; expected a number such as 1.53+0.008i"
        ) from None
