"""Results of a run folder in formats that other programs read: VTK, CSV, MATLAB."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import value_at
from lidar_mi.experiment.export_flight import FLIGHT_FILES, flight_results
from lidar_mi.experiment.folder.records import STUDY, read_record
from lidar_mi.experiment.folder.run_folder import RESULTS
from lidar_mi.experiment.stages.rendering import IMAGES
from lidar_mi.io.exr import read_scan
from lidar_mi.io.folder import make_folder
from lidar_mi.io.netcdf import read_netcdf
from lidar_mi.units import to_si

if TYPE_CHECKING:
    from lidar_mi.retrieval.vortices.pair import VortexPairFit


FORMATS = ("vtk", "csv", "mat", "openfast")
_WINDS = ("wind", "wind_volume", "wind3d")
_AHEAD = {"units": "m", "long_name": "distance ahead of the first image's telescope"}


@checked_arguments
def export(
    folder: str | Path,
    format: str = "vtk",
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write the results of a run for ParaView, a spreadsheet or MATLAB.

    Winds, volumes, both images, lines of sight and vortices, as far as the run has them; of an
    encounter the path of the aircraft in every flight, the vortices of its track, winds and images
    of the slabs. Values, standard errors, flags and NaN are those of the run. Positions are x
    ahead, y to port, z up, in m, from the telescope at the first scan, or from the start of the
    path in an encounter.

    Parameters
    ----------
    folder : path
        Of a run or of a flight.
    format : {"vtk", "csv", "mat", "openfast"}
        VTK: a file for each source and method, ``.vti`` on uniform grids, ``.vts`` for images of
        several gates, whose beams spread, ``.vtu`` for lines of sight and vortices. CSV: a table
        for each result, one row a vector, with units in the head and flags in words. MATLAB: a
        file for each result, with structures ``units``, ``long_name``, ``dims``. OpenFAST: lines of
        a coherent lidar that looks into one direction, as `write_openfast`.
    out : path, optional
        Folder of the files. Default: one of the format's name in the run's folder.
    overwrite : bool
        Replace files that are there.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    InputError
        No run folder, a run without results, a file that is damaged, an unknown format, or a file
        that is there.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> lm.export("outputs/wake_sensor", "csv")            # doctest: +SKIP
    """
    if format not in FORMATS:
        raise InputError(
            f"format: {format!r} is not allowed; expected one of {', '.join(FORMATS)}, or control, "
            "of flights (lm.export_control)"
        )
    folder = Path(folder)
    if (folder / STUDY).is_file():
        raise InputError(f"{folder}: a folder of several runs; expected one of them, {folder}/...")
    record = read_record(folder)
    if value_at(record["experiment"], "encounter") is not None:
        results = dict(flight_results(folder, placed=format != "csv"))
        if not results:
            raise InputError(
                f"{folder}: a flight without results yet; expected "
                f"{', '.join(FLIGHT_FILES.values())}, which lidar-mi fly writes at its end"
            )
    elif format == "openfast":
        results = {"lines_of_sight": _coherent_lines(folder)}
    else:
        results = dict(_results(folder, record))
    if not results:
        raise InputError(f"{folder}: has no results yet; expected a run with images or winds")
    out = folder / format if out is None else Path(out)
    files = dict(_files(out, format, results))
    # before the first file is written: an existing one stops all
    existing = [path for path in files if path.exists()]
    if existing and not overwrite:
        raise InputError(
            f"{existing[0]}: exists; expected another folder (-o DIR), or --overwrite to replace it"
        )
    make_folder(out)
    for write in files.values():
        write()
    return list(files)


def _files(
    out: Path, format: str, results: dict[str, xr.Dataset]
) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Files to write, with their writers."""
    from lidar_mi.io.csv_file import write_csv
    from lidar_mi.io.mat_file import write_mat
    from lidar_mi.io.openfast import write_openfast
    from lidar_mi.io.vtk_file import suffix, write_vtk

    if format == "openfast":
        path = out / "lines_of_sight.out"
        yield path, partial(write_openfast, path, results["lines_of_sight"])
        return
    write = {"vtk": write_vtk, "csv": write_csv, "mat": write_mat}[format]
    for name, data in results.items():
        parts = _separated(name, data) if format == "vtk" else [(name, data)]
        for stem, part in parts:
            path = out / f"{stem}{suffix(part) if format == 'vtk' else f'.{format}'}"
            yield path, partial(write, path, part)


def _separated(name: str, data: xr.Dataset) -> Iterator[tuple[str, xr.Dataset]]:
    """A data set for each source, method or fit."""
    labels = [dim for dim in ("source", "algorithm", "fit", "flight") if dim in data.dims]
    if not labels:
        yield name, data
        return
    for label in data[labels[0]].values:
        yield from _separated(f"{name}_{label}", data.sel({labels[0]: label}))


def _results(folder: Path, record: Mapping[str, Any]) -> Iterator[tuple[str, xr.Dataset]]:
    """Data sets with the coordinates x, y, z, as far as their files are there."""
    from lidar_mi.io.vortex_file import read_vortices

    for name in IMAGES:
        if (folder / f"{name}.exr").is_file():
            yield name, _placed_scan(read_scan(folder / f"{name}.exr"))
    for name in _WINDS:
        if (folder / RESULTS[name]).is_file():
            wind = read_netcdf(folder / RESULTS[name])
            # cross-flow winds have no x: they are means over the slab
            yield name, wind if "x" in wind.coords else wind.assign_coords(x=_slab(record))
    if (folder / RESULTS["lines"]).is_file():
        lines = read_netcdf(folder / RESULTS["lines"])
        coherent = "azimuth" in lines
        yield "lines_of_sight", _gates(xr.decode_cf(lines)) if coherent else _placed_lines(lines)
    if (folder / RESULTS["vortices"]).is_file():
        fits = read_vortices(folder / RESULTS["vortices"])
        if fits:
            yield "vortices", _vortices(fits).assign_coords(x=_slab(record))


def _slab(record: Mapping[str, Any]) -> xr.Variable:
    """Middle of the slab in which cross-flow winds are retrieved."""
    # a record has quantities as they were given, with their units
    start, depth = (
        to_si(value_at(record["experiment"], f"scan.{key}"), "m", "500 m")
        for key in ("range", "thickness")
    )
    return xr.Variable((), start + depth / 2, _AHEAD)


def _placed_scan(scan: xr.Dataset) -> xr.Dataset:
    """An image with the place of every pixel; of several gates, whose beams spread, without Y."""
    about = scan.attrs
    start, stop, count = about["gate_start"], about["gate_stop"], scan.sizes["gate"]
    telescope, centre = about["telescope_position"], (start + stop) / 2
    if count == 1:
        return scan.isel(gate=0, drop=True).assign_coords(x=((), float(telescope + centre), _AHEAD))
    edges = np.linspace(start, stop, count + 1)
    middle = xr.DataArray((edges[1:] + edges[:-1]) / 2, dims="gate")
    # a range along the beam, projected on x
    if about["gate_kind"] == "spherical":
        middle = middle / np.sqrt(1 + (scan["y"] ** 2 + scan["z"] ** 2) / centre**2)
    dims = ("gate", "z", "y")
    x = middle.broadcast_like(scan["S0"]).transpose(*dims)
    # beams spread from the telescope in proportion to x
    places = {"x": telescope + x, "y": x / centre * scan["y"], "z": x / centre * scan["z"]}
    gates = scan.drop_vars(["y", "z"]).rename_dims(y="column", z="row")
    dims = ("gate", "row", "column")
    attrs = {"x": _AHEAD, "y": scan["y"].attrs, "z": scan["z"].attrs}
    # sums over the gates have no place along x
    sums = [name for name, field in gates.data_vars.items() if "gate" not in field.dims]
    return gates.drop_vars(sums).assign_coords(
        {n: (dims, p.transpose("gate", "z", "y").values, attrs[n]) for n, p in places.items()}
    )


def _placed_lines(lines: xr.Dataset) -> xr.Dataset:
    """Lines of sight with the middle of their range bins as place, a column a component."""
    direction = lines["direction"]
    places = lines["range"] * direction  # from the telescope at the first image
    # other programs read scalars: a variable for each component
    split = lines.drop_vars([n for n in lines.variables if "axis" in lines[n].dims])
    for axis in ("x", "y", "z"):
        about = {"units": "m", "long_name": f"{axis} of the middle of the range bin"}
        split[axis] = "line", places.sel(axis=axis).values, about
    for axis in ("x", "y", "z"):
        toward = {"units": "1", "long_name": f"{axis} component of the line's unit vector"}
        split[f"direction_{axis}"] = "line", direction.sel(axis=axis).values, toward
        velocity = lines["platform_velocity"]
        split[f"platform_velocity_{axis}"] = velocity.sel(axis=axis, drop=True)
    return split.set_coords(["x", "y", "z"])


def _coherent_lines(folder: Path) -> xr.Dataset:
    path = folder / RESULTS["coherent_lines"]
    lines = read_netcdf(path) if path.is_file() else xr.Dataset()
    if "azimuth" not in lines:
        raise InputError(
            f"{folder}: has no lines of a coherent lidar; expected a run with doppler.kind: "
            "coherent for the format openfast"
        )
    return xr.decode_cf(lines)


def _gates(lines: xr.Dataset) -> xr.Dataset:
    """Gates of a coherent lidar with their places to the east, to the north and up of it."""
    first = lines["time"][0]
    seconds = (lines["time"] - first) / np.timedelta64(1, "s")
    azimuth, elevation = np.deg2rad(lines["azimuth"]), np.deg2rad(lines["elevation"])
    level = lines["range"] * np.cos(elevation)
    places = {
        "x": ("to the east of the lidar", level * np.sin(azimuth)),
        "y": ("to the north of the lidar", level * np.cos(azimuth)),
        "z": ("above the lidar", lines["range"] * np.sin(elevation)),
    }
    coordinates = {"time": seconds.assign_attrs(units="s", long_name=f"after {first.values}")}
    for name, (words, place) in places.items():
        about = {"units": "m", "long_name": words}
        coordinates[name] = place.transpose("time", "range").assign_attrs(about)
    placed = lines.assign_coords(coordinates)
    # variables of vortices, not of gates, are omitted
    other = [name for name, field in placed.variables.items() if {*field.dims} - {"time", "range"}]
    return placed.drop_vars(other).stack(gate=("time", "range")).reset_index("gate")


def _vortices(fits: "dict[str, VortexPairFit]") -> xr.Dataset:
    """Parameters of fitted pairs with standard errors: of each vortex, and of the pair."""
    sides = ("port", "starboard")
    pairs = []
    for fit in fits.values():
        variables: dict[str, tuple[Any, ...]] = {}
        for name, quantity in fit.quantities.items():
            about = {"units": quantity.units, "long_name": quantity.long_name}
            side, _, parameter = name.partition("_")
            # of the pair, not of one of its vortices
            if side not in sides:
                variables[name] = (), quantity.value, about
                variables[f"{name}_stderr"] = (), quantity.stderr, {"units": quantity.units}
            elif side == "port":
                of_sides = [fit.quantities[f"{label}_{parameter}"] for label in sides]
                about["long_name"] = quantity.long_name.replace(" of the port vortex", "")
                variables[parameter] = "vortex", [each.value for each in of_sides], about
                errors = [each.stderr for each in of_sides]
                variables[f"{parameter}_stderr"] = "vortex", errors, {"units": quantity.units}
        variables["accepted"] = (), int(fit.success), {"units": "1"}
        pairs.append(xr.Dataset(variables))
    joined = xr.concat(pairs, "fit").assign_coords(fit=list(fits), vortex=list(sides))
    return joined.set_coords(["y", "z"])
