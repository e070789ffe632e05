"""VTK files: fields on grids and at points in space, for ParaView and its kin."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import xarray as xr
from pyevtk.hl import gridToVTK, imageToVTK, pointsToVTK

from lidar_mi import __version__
from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically

AXES = ("x", "y", "z")
# of a coordinate's steps, relative to their mean: nodes of float32
_UNEVEN = 1e-4
_LEGACY = {"i1": "char", "i2": "short", "i4": "int", "i8": "vtktypeint64"}
_LEGACY |= {"u1": "unsigned_char", "u2": "unsigned_short", "u4": "unsigned_int"}
_LEGACY |= {"u8": "vtktypeuint64", "f4": "float", "f8": "double"}


def suffix(data: xr.Dataset) -> str:
    """``.vti`` for uniform axes, ``.vtr`` for uneven ones, ``.vts`` if curved; points: ``.vtu``."""
    if any(data[axis].ndim > 1 for axis in AXES):
        return ".vts"
    if not set(AXES) & set(data.dims):
        return ".vtu"
    return ".vti" if all(_is_uniform(np.atleast_1d(data[axis].values)) for axis in AXES) else ".vtr"


def write_vtk(path: str | Path, data: xr.Dataset) -> None:
    """Write the numbers of a data set as point data of a grid or of points.

    Values keep their types and NaN; u, v, w together become the vector ``wind``, of u = 0 where
    there is no u. Numbers without dimensions are repeated at every point of a list, and omitted
    on grids. Units are part of an array's name: ``v [m s-1]``.

    path: with the suffix that `suffix` gives: XML. Or ``.vtk``, the legacy format, of uniform axes.
    data: with the coordinates x, y, z in m, each a number, an axis, or a value of every node; one
        dimension of another name: points.

    Raises InputError: as of `write_atomically`; uneven axes in the legacy format.
    """
    kind, shape = suffix(data), data[[*AXES]].sizes
    dims = tuple(map(str, shape)) if kind in (".vts", ".vtu") else AXES
    points: dict[str, np.ndarray | tuple[np.ndarray, ...]] = {}
    for name, variable in data.variables.items():
        on_nodes = set(variable.dims) & set(dims) or (kind == ".vtu" and not variable.dims)
        if variable.dtype.kind in "iuf" and name not in AXES and on_nodes:
            points[_label(data, str(name))] = _values(data[name], data, dims)
    if {"v", "w"} <= set(data.data_vars) and set(data["v"].dims) & set(dims):
        v, w = (_values(data[name], data, dims) for name in ("v", "w"))
        u = _values(data["u"], data, dims) if "u" in data else np.zeros_like(v)
        points["wind [m s-1]"] = u, v, w
    axes = [np.atleast_1d(data[axis].values).astype(float) for axis in AXES]
    start: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    if kind == ".vti":
        start = tuple(float(axis[0]) for axis in axes)
        steps = tuple(float(axis[-1] - axis[0]) / max(axis.size - 1, 1) or 1.0 for axis in axes)
    if Path(path).suffix.lower() == ".vtk":
        if kind != ".vti":
            raise InputError(f"{path}: uneven axes; expected a file {kind}")
        write_atomically(path, _legacy(start, steps, tuple(axis.size for axis in axes), points))
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "data"
        if kind == ".vti":
            imageToVTK(str(file), start, steps, None, points)
        elif kind == ".vtr":
            gridToVTK(str(file), *axes, None, points)
        else:
            nodes = [_values(data[axis].astype(float), data, dims) for axis in AXES]
            if kind == ".vts":
                gridToVTK(str(file), *nodes, None, points)
            else:
                pointsToVTK(str(file), *nodes, points)
        write_atomically(path, file.with_suffix(kind).read_bytes())


def _legacy(
    start: Sequence[float],
    steps: Sequence[float],
    sizes: Sequence[int],
    points: Mapping[str, np.ndarray | tuple[np.ndarray, ...]],
) -> bytes:
    """VTK's legacy format: big endian, white space in names as in a URL."""
    rows = {"DIMENSIONS": sizes, "ORIGIN": start, "SPACING": steps}
    text = [f"# vtk DataFile Version 3.0\n# software: lidar-mi {__version__}\nBINARY"]
    text += ["DATASET STRUCTURED_POINTS"]
    text += [f"{name} {' '.join(map(repr, values))}" for name, values in rows.items()]
    text += [f"POINT_DATA {sizes[0] * sizes[1] * sizes[2]}", ""]
    content = "\n".join(text).encode()
    for name, values in points.items():
        parts = values if isinstance(values, tuple) else (values,)
        kind, label = _LEGACY[parts[0].dtype.str[1:]], quote(name)
        vector = len(parts) > 1
        head = f"VECTORS {label} {kind}\n" if vector else f"SCALARS {label} {kind} 1\n"
        content += (head + ("" if vector else "LOOKUP_TABLE default\n")).encode()
        table = np.stack([part.ravel(order="F") for part in parts], -1)
        content += table.astype(table.dtype.newbyteorder(">")).tobytes() + b"\n"
    return content


def _is_uniform(axis: np.ndarray) -> bool:
    steps = np.diff(axis)
    return steps.size == 0 or bool(np.ptp(steps) <= _UNEVEN * abs(steps.mean()))


def _label(data: xr.Dataset, name: str) -> str:
    return f"{name} [{data[name].attrs['units']}]" if "units" in data[name].attrs else name


def _values(variable: xr.DataArray, data: xr.Dataset, dims: tuple[str, ...]) -> np.ndarray:
    """On all nodes, in the memory layout that VTK has: x runs fastest."""
    sizes = {dim: data.sizes.get(dim, 1) for dim in dims}
    missing = {dim: size for dim, size in sizes.items() if dim not in variable.dims}
    raw: Any = variable.variable  # xarray states no types for its `set_dims`
    return np.asfortranarray(raw.set_dims(missing | dict(variable.sizes)).transpose(*dims).values)
