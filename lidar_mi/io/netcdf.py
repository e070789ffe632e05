"""NetCDF files."""

from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically

# what the format libraries raise on damaged files
_FORMAT_ERRORS = (OSError, ValueError, TypeError, LookupError, RuntimeError, AttributeError)


def open_netcdf(path: str | Path) -> xr.Dataset:
    """A NetCDF-4 or NetCDF-3 file, its times as numbers, its values read when they are asked for.

    Raises
    ------
    InputError
        A file that cannot be read, is no NetCDF, or is damaged.
    """
    path = Path(path)
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
    try:
        return xr.open_dataset(path, engine=engine, decode_times=False)
    except _FORMAT_ERRORS as error:
        raise _damaged(path, error) from None


def read_netcdf(path: str | Path) -> xr.Dataset:
    """The whole of a NetCDF file, in memory; errors as in `open_netcdf`."""
    with open_netcdf(path) as data:
        try:
            return data.load()
        except _FORMAT_ERRORS as error:
            raise _damaged(path, error) from None


def load_variable(variable: xr.DataArray, path: str | Path) -> xr.DataArray:
    """A variable of an open file, its values in memory.

    Raises
    ------
    InputError
        The file is damaged where the values are.
    """
    try:
        return variable.load()
    except _FORMAT_ERRORS as error:
        raise _damaged(path, error) from None


def _damaged(path, error):
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return InputError(f"{path}: is damaged ({reason}); allowed: a whole NetCDF file")


def write_netcdf(data: xr.Dataset, path: str | Path) -> None:
    """Write a data set as compressed NetCDF-4, whole or not at all.

    Raises
    ------
    InputError
        No folder to write into.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    packed: dict[Any, dict[str, Any]]
    packed = {n: {"zlib": True, "complevel": 4} for n, v in data.data_vars.items() if v.ndim}
    # CF 2.5.1: no missing values in coordinate variables
    packed |= {name: {"_FillValue": None} for name in data.coords if name in data.dims}
    write_atomically(path, lambda part: data.to_netcdf(part, engine="h5netcdf", encoding=packed))
