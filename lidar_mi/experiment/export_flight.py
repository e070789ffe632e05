"""The data sets of a flight's folder, placed for other programs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.io.netcdf import read_netcdf

FLIGHT_FILES = {"series": "flight.nc", "track": "track.nc", "slabs": "slabs.nc"}
"""Files of the time series, of the lidar's track, of images and wind vectors of its slabs."""

_SIDES = ("port", "starboard")
_FOR_A_REPLAY = ["parameter", "parameter_2", "vector_row", "vector_column", "arrival"]


def flight_results(folder: Path, *, placed: bool) -> Iterator[tuple[str, xr.Dataset]]:
    """Flights, track, winds and images of the slabs, as far as there are any.

    Places are those of the path frame: x along the path from where the flight starts, y to port, z
    up, m.

    folder: of a flight.
    placed: the track as points in space, a vortex each; else a row for each slab and source, and
        without images.
    """
    files = {name: folder / file for name, file in FLIGHT_FILES.items()}
    if files["series"].is_file():
        yield "flight", read_netcdf(files["series"]).set_coords(["x", "y", "z"])
    if files["track"].is_file():
        # parameters with their covariances, and vectors, are for a replay
        track = read_netcdf(files["track"]).drop_dims(_FOR_A_REPLAY, errors="ignore")
        if placed:
            sources = map(str, track["source"].values)
            yield from ((f"vortices_{name}", _points(track, name)) for name in sources)
        else:
            yield "track", track
    if files["slabs"].is_file():
        slabs = read_netcdf(files["slabs"]).swap_dims(slab="x").set_coords("x")
        yield "slab_winds", _of_slabs(slabs, "y", "z")
        if placed:
            images = _of_slabs(slabs, "image_y", "image_z")
            yield "slab_images", images.rename(image_y="y", image_z="z")


def _of_slabs(slabs: xr.Dataset, *axes: str) -> xr.Dataset:
    """Variables of all nodes of the slabs."""
    names = [name for name, value in slabs.data_vars.items() if {"x", *axes} == set(value.dims)]
    chosen = slabs[names]
    return chosen.drop_vars([name for name in chosen.coords if name not in ("x", *axes)])


def _points(track: xr.Dataset, source: str) -> xr.Dataset:
    """The vortices that one source has, a point each."""
    vortices = track.sel(source=source, drop=True)
    names = [str(name).removeprefix("port_") for name in vortices if str(name).startswith("port_")]
    shared = vortices[["x", "time"]].to_dataarray("name").values
    parts_of: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for side in _SIDES:
        for name in names:
            parts_of[name].append(vortices[f"{side}_{name}"].values)
    columns = {name: np.concatenate(parts) for name, parts in parts_of.items()}
    columns |= {"x": np.tile(shared[0], 2), "time": np.tile(shared[1], 2)}
    columns["side"] = np.repeat([1.0, -1.0], vortices.sizes["slab"])
    valid = np.isfinite(columns["y"]) & np.isfinite(columns["z"])
    units = {name: vortices[f"port_{name}"].attrs.get("units", "1") for name in names}
    units |= {"x": "m", "time": "s", "side": "1"}
    data = {name: ("point", v[valid], {"units": units[name]}) for name, v in columns.items()}
    return xr.Dataset(data).set_coords(["x", "y", "z"])
