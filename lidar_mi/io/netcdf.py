"""NetCDF files."""

import math
from pathlib import Path
from typing import Any

import dask
import h5py
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.size import check_size


def open_netcdf(path: str | Path) -> xr.Dataset:
    """A NetCDF-4 or NetCDF-3 file, its times as numbers, its values read when they are asked for.

    Raises
    ------
    InputError
        A file that cannot be read, is no NetCDF, is damaged, or declares axes or chunks that are
        out of proportion to it.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: a device or a pipe; allowed: a NetCDF file")
    try:
        with path.open("rb") as file:
            magic = file.read(8)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); allowed: a NetCDF file"
        ) from None
    if magic == b"\x89HDF\r\n\x1a\n":
        engine = "h5netcdf"
    elif magic[:4] in (b"CDF\x01", b"CDF\x02"):
        engine = "scipy"
    else:
        raise InputError(f"{path}: is not NetCDF; allowed: NetCDF-4 (HDF5) or NetCDF-3 classic")
    for what, size in _declared(path) if engine == "h5netcdf" else ():
        check_size(path, size, what)
    try:
        # axes without a name, of HDF5 that is no NetCDF, are named without a warning
        unnamed: dict[str, Any] = {"phony_dims": "access"} if engine == "h5netcdf" else {}
        return xr.open_dataset(path, engine=engine, decode_times=False, **unnamed)
    except Exception as error:  # any exception of the libraries in a damaged file
        raise _damaged(path, error) from None


def _declared(path):
    """Bytes read on opening, and the largest chunk that must be read for a value."""
    found = []
    try:
        with h5py.File(path, "r") as file:
            file.attrs.get("_nc3_strict")  # h5netcdf could not even be closed without
            for name, variable in file.items():
                if isinstance(variable, h5py.Dataset):
                    axis = variable.shape if variable.ndim == 1 else None
                    for shape in (axis, variable.chunks):
                        if shape is not None:
                            found.append((name, math.prod(shape) * variable.dtype.itemsize))
    except Exception as error:
        raise _damaged(path, error) from None
    return found


def read_netcdf(path: str | Path) -> xr.Dataset:
    """The whole of a NetCDF file, in memory; errors as in `open_netcdf` and `load_variable`."""
    with open_netcdf(path) as data:
        check_size(path, data.nbytes)
        try:
            return data.load()
        except Exception as error:
            raise _damaged(path, error) from None


def load_variable(variable: xr.DataArray, path: str | Path) -> xr.DataArray:
    """A variable of an open file, its values in memory.

    Raises
    ------
    InputError
        The file is damaged at the values, or declares more than it can hold.
    """
    check_size(path, variable.nbytes, str(variable.name))
    try:
        return variable.load()
    except Exception as error:
        raise _damaged(path, error) from None


def _damaged(path, error):
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    return InputError(f"{path}: is damaged ({reason}); allowed: a whole NetCDF file")


def write_netcdf(data: xr.Dataset, path: str | Path) -> None:
    """Write a data set as compressed NetCDF-4, whole or not at all.

    The file is composed in memory, as HDF5 crashes if the disk is full.

    Raises
    ------
    InputError
        As of `write_atomically`.
    """
    packed: dict[Any, dict[str, Any]]
    packed = {n: {"zlib": True, "complevel": 4} for n, v in data.data_vars.items() if v.ndim}
    # CF 2.5.1: no missing values in coordinate variables
    packed |= {name: {"_FillValue": None} for name in data.coords if name in data.dims}
    # in a campaign xarray would ask the scheduler for a lock on what is in memory here
    with dask.config.set(scheduler="synchronous"):
        content = data.to_netcdf(engine="h5netcdf", encoding=packed)
    write_atomically(path, content)
