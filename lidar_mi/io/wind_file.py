"""Winds in the format that the name of the file says."""

from pathlib import Path

import xarray as xr

from lidar_mi.io.csv_file import write_csv
from lidar_mi.io.flo_file import write_flo
from lidar_mi.io.mat_file import write_mat
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.vtk_file import write_vtk

SERIES = (".nc", ".csv", ".mat")
"""Suffixes of formats that hold several winds."""

SUFFIXES = (*SERIES, ".vtk", ".vti", ".flo")
"""Suffixes of all formats."""


def write_wind(path: str | Path, wind: xr.Dataset, pixel: tuple[float, float]) -> str:
    """Write a wind as NetCDF, CSV, MATLAB, VTK (legacy or XML) or Middlebury flow, by the suffix.

    path: with one of `SUFFIXES`.
    wind: as of `retrieve_wind`; with one of `SERIES` also as of `retrieve_winds`.
    pixel: size of the images' pixels along z and y, m.

    Returns
    -------
    str
        What the format loses; empty: nothing.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".nc":
        write_netcdf(wind, path)
    elif suffix == ".csv":
        write_csv(path, wind)
        return "attributes (method, dt, ...)"
    elif suffix == ".mat":
        write_mat(path, wind)
        return "attributes (method, dt, ...)"
    elif suffix == ".flo":
        write_flo(path, wind, pixel)
        return "standard errors, places, times, reasons of flags (flagged vectors: 1e10)"
    else:
        # the image plane, wherever ahead it is
        write_vtk(path, wind.assign_coords(x=0.0))
        return "attributes (method, dt, ...), names of flags"
    return ""
