"""NetCDF files."""

import math
import os
import shlex
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.compression import compression
from lidar_mi.io.size import check_size

if TYPE_CHECKING:
    import h5py


# Values of cells that were never written (NC_FILL_* of netcdf.h). None for types of one byte, all
# of whose values are in use; the library does not check them either.
_NEVER_WRITTEN = {
    "i2": -32767,
    "u2": 65535,
    "i4": -2147483647,
    "u4": 4294967295,
    "i8": -9223372036854775806,
    "u8": 18446744073709551614,
    "f4": 9.969209968386869e36,
    "f8": 9.969209968386869e36,
}
# First bytes of files, their kind, and the command that converts them to NetCDF.
_KINDS = (
    (b"PK\x03\x04", "is a zip archive", "unzip {0}"),
    (b"\x0e\x03\x13\x01", "is HDF4", "ncks {0} out.nc"),
    (b"GRIB", "is GRIB", "cdo -f nc4 copy {0} out.nc"),
    (b"netcdf ", "is NetCDF as text (CDL)", "ncgen -4 -o out.nc {0}"),
)
_ZARR = (".zgroup", ".zarray", ".zattrs", ".zmetadata", "zarr.json")
_LIBRARY = "netCDF4"
"""Optional library for files that h5py and SciPy cannot read."""


def open_netcdf(path: str | Path, group: str | None = None) -> xr.Dataset:
    """A NetCDF-4 or NetCDF-3 file, times as numbers, values read on demand.

    With a ``group``, the variables of that group of a NetCDF-4 file (`groups`).

    Values are unpacked and missing ones NaN, as CF says: ``_FillValue``, ``missing_value`` and,
    without ``_FillValue``, what the library writes into cells that were never written. The limits
    ``valid_min``, ``valid_max`` and ``valid_range`` hold in `load_variable`.

    Raises InputError: a file that cannot be read, is no NetCDF, or NetCDF of a kind that is not
    read; is damaged, or declares axes or chunks that are out of proportion to it.
    """
    with warnings.catch_warnings():
        # several values may stand for missing ones
        warnings.simplefilter("ignore", xr.SerializationWarning)
        try:
            raw = _open(path, group, decode_cf=False)
            for variable in raw.variables.values():
                _mark_missing(variable)
            return xr.decode_cf(raw, decode_times=False)
        except InputError:
            raise
        except Exception as error:  # any exception of the libraries in a damaged file
            raise _damaged(path, error) from None


def groups(path: str | Path) -> list[str]:
    """Names of the groups at the top of a NetCDF file; errors as in `open_netcdf`."""
    import h5py

    path = Path(path)
    if _kind(path) != "HDF5":
        return []
    try:
        with h5py.File(path, "r") as file:
            return [name for name, member in file.items() if isinstance(member, h5py.Group)]
    except Exception as error:
        raise _damaged(path, error) from None


def _open(path: str | Path, group: str | None = None, **how: Any) -> xr.Dataset:
    """The data set of a file, by the library that reads its kind."""
    path = Path(path)
    kind = _kind(path)
    unread = ""
    if kind == "CDF-5":
        unread = f"is NetCDF of 64-bit data (CDF-5); {_convert('nccopy -k nc4 {0} out.nc', path)}"
    elif kind == "HDF5":
        declared, filters = _declared(path, group)
        for variable, size in declared:
            check_size(path, size, variable)
        if filters:
            convert = _convert("nccopy -d 4 -F none {0} out.nc", path, "zlib")
            unread = f"is compressed with {', '.join(filters)}; {convert}"
    if unread and not find_spec(_LIBRARY):
        raise InputError(f"{path}: {unread}, or pip install {_LIBRARY}, which reads it")
    engine = _LIBRARY.lower() if unread else "h5netcdf" if kind == "HDF5" else "scipy"
    # axes without a name, of HDF5 that is no NetCDF, are named without a warning
    unnamed: dict[str, Any] = {"phony_dims": "access"} if engine == "h5netcdf" else {}
    try:
        # absolute, as xarray takes ~ for a home and a:// for the network
        within: dict[str, Any] = {} if group is None else {"group": group}
        return xr.open_dataset(os.path.abspath(path), engine=engine, **within, **unnamed, **how)
    except Exception as error:  # any exception of the libraries in a damaged file
        if unread:
            raise InputError(f"{path}: {unread}") from None
        raise _damaged(path, error) from None


def _kind(path: Path) -> str:
    """CDF-1, CDF-2, CDF-5 or HDF5, by how a file begins; all others are refused."""
    import h5py

    if path.is_dir() and any((path / name).exists() for name in _ZARR):
        name = shlex.quote(str(path))
        raise InputError(
            f'{path}: is a Zarr store; expected a NetCDF file: python -c "import sys, xarray; '
            f"xarray.open_zarr(sys.argv[1]).to_netcdf('out.nc')\" {name}"
        )
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: a device or a pipe; allowed: a NetCDF file")
    try:
        with path.open("rb") as file:
            magic = file.read(8)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); allowed: a NetCDF file"
        ) from None
    if magic[:3] == b"CDF" and magic[3:4] in (b"\x01", b"\x02", b"\x05"):
        return f"CDF-{magic[3]}"
    if packed := compression(magic):
        name, program = packed
        raise InputError(f"{path}: is compressed with {name}; {_convert(f'{program} {{0}}', path)}")
    for begin, contents, command in _KINDS:
        if magic.startswith(begin):
            raise InputError(f"{path}: {contents}; {_convert(command, path)}")
    # HDF5 may begin behind a block of the user's
    if magic and h5py.is_hdf5(os.fsencode(path)):
        return "HDF5"
    raise InputError(f"{path}: is not NetCDF; allowed: NetCDF-4 (HDF5) or NetCDF-3 classic")


def _convert(command: str, path: Path, target: str = "NetCDF-4 or NetCDF-3 classic") -> str:
    return f"expected {target}: {command.format(shlex.quote(str(path)))}"


def _declared(path: Path, group: str | None) -> tuple[list[tuple[str, int]], list[str]]:
    """Bytes read on opening and the largest chunk read for a value; filters that are missing."""
    import h5py

    sizes: list[tuple[str, int]] = []
    filters: dict[int, str] = {}
    try:
        with h5py.File(path, "r") as file:
            file.attrs.get("_nc3_strict")  # h5netcdf could not even be closed without
            within = file if group is None else file[group]
            inner = [name for name, member in within.items() if isinstance(member, h5py.Group)]
            for name, variable in within.items():
                if isinstance(variable, h5py.Dataset):
                    axis = variable.shape if variable.ndim == 1 else None
                    for shape in (axis, variable.chunks):
                        if shape is not None:
                            sizes.append((name, math.prod(shape) * variable.dtype.itemsize))
                    filters |= _missing_filters(variable)
    except Exception as error:
        raise _damaged(path, error) from None
    if inner and not sizes:
        command = f"ncks -G : -g {shlex.quote(inner[0])} {{0}} out.nc"
        raise InputError(
            f"{path}: has all variables in groups ({', '.join(inner)}); "
            f"{_convert(command, path, 'them outside')}"
        )
    return sizes, list(filters.values())


def _missing_filters(variable: "h5py.Dataset") -> dict[int, str]:
    """Filters of a variable that this HDF5 library lacks, by their registered numbers."""
    import h5py

    settings = variable.id.get_create_plist()
    stored = [settings.get_filter(index) for index in range(settings.get_nfilters())]
    return {
        code: name.decode("utf-8", "replace").split(";")[0].strip() or f"filter {code}"
        for code, _, _, name in stored
        if not h5py.h5z.filter_avail(code)
    }


def _mark_missing(variable: xr.Variable) -> None:
    """Mark the values that are missing by CF and that xarray does not recognise.

    What the library writes into cells that were never written; the sign of ``missing_value`` where
    ``_Unsigned`` changes that of the values.
    """
    attributes, kind = variable.attrs, variable.dtype
    signs = {"true": "u", "false": "i"}.get(str(attributes.get("_Unsigned", "")).lower())
    if signs and kind.kind in "iu":
        if "missing_value" in attributes:
            stored = np.ravel(attributes["missing_value"]).astype(kind)
            attributes["missing_value"] = stored.view(f"{signs}{kind.itemsize}")
        return
    fill = _NEVER_WRITTEN.get(kind.str[1:])
    # never a measurement, even if another fill value was declared later
    if fill is not None and kind.kind == "f":
        also = np.append(np.ravel(attributes.get("missing_value", [])), fill)
        attributes["missing_value"] = also.astype(kind)
    elif fill is not None and "_FillValue" not in attributes:
        attributes["_FillValue"] = kind.type(fill)


def read_netcdf(path: str | Path) -> xr.Dataset:
    """The whole of a NetCDF file, in memory; errors as in `open_netcdf` and `load_variable`."""
    with _open(path, decode_times=False) as data:
        check_size(path, data.nbytes)
        try:
            return data.load()
        except Exception as error:
            raise _damaged(path, error) from None


def load_variable(variable: xr.DataArray, path: str | Path) -> xr.DataArray:
    """A variable of an open file, its values in memory, NaN where they are not valid.

    Raises InputError: the file is damaged at the values, declares more than it can hold, or has
    limits of valid values that are no numbers.
    """
    check_size(path, variable.nbytes, str(variable.name))
    try:
        loaded = variable.load()
    except Exception as error:
        raise _damaged(path, error) from None
    low, high = valid_range(variable, path)
    bad = (loaded < low) | (loaded > high) if math.isfinite(low) or math.isfinite(high) else None
    return loaded if bad is None or not bad.any() else loaded.where(~bad)


def valid_range(variable: xr.DataArray, path: str | Path) -> tuple[float, float]:
    """Least and largest valid value of a variable of `open_netcdf`; infinite: no limit.

    Limits of packed data are packed, too (CF 8.1); those of a wider floating-point type than the
    packed data are of the unpacked (NetCDF Users Guide, attribute conventions).

    Raises InputError: limits that are no numbers.
    """
    limits = [-np.inf, np.inf]
    for name, ends in (("valid_min", [0]), ("valid_max", [1]), ("valid_range", [0, 1])):
        if name not in variable.attrs or variable.dtype.kind not in "iuf":
            continue
        limit = np.ravel(variable.attrs[name])
        if limit.dtype.kind not in "iuf" or limit.size != len(ends):
            raise InputError(
                f"{path}: variable {variable.name!r} has the {name} {variable.attrs[name]!r}; "
                f"expected {'two numbers' if len(ends) == 2 else 'a number'}"
            )
        packing = variable.encoding
        scale, offset = packing.get("scale_factor", 1), packing.get("add_offset", 0)
        stored = np.dtype(packing.get("dtype", variable.dtype))
        wider = limit.dtype.kind == "f" and (
            stored.kind != "f" or limit.dtype.itemsize > stored.itemsize
        )
        # in the steps and the type of xarray, so that the limit itself is valid
        values = limit.astype(variable.dtype if variable.dtype.kind == "f" else float)
        if ("scale_factor" in packing or "add_offset" in packing) and not wider:
            if packing.get("_Unsigned") == "true" and limit.dtype.kind == "i":
                values = limit.view(f"u{limit.dtype.itemsize}").astype(values.dtype)
            values *= scale
            values += offset
            if scale < 0:
                values, ends = values[::-1], [1 - end for end in ends[::-1]]
        for end, value in zip(ends, values, strict=True):
            limits[end] = float(value)
    return limits[0], limits[1]


def _damaged(path: str | Path, error: Exception) -> InputError:
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    return InputError(f"{path}: is damaged ({reason}); allowed: a whole NetCDF file")


def write_netcdf(data: xr.Dataset, path: str | Path) -> None:
    """Write a data set as compressed NetCDF-4, whole or not at all.

    The file is composed in memory, as HDF5 crashes if the disk is full.
    """
    import dask

    packed: dict[Any, dict[str, Any]]
    packed = {n: {"zlib": True, "complevel": 4} for n, v in data.data_vars.items() if v.ndim}
    # CF 2.5.1: no missing values in coordinate variables
    packed |= {name: {"_FillValue": None} for name in data.coords if name in data.dims}
    # in a campaign xarray would ask the scheduler for a lock on what is in memory here
    with dask.config.set(scheduler="synchronous"):
        content = data.to_netcdf(engine="h5netcdf", encoding=packed)
    write_atomically(path, content)
