"""Winds as CF data sets: what a method retrieved on the axes of its images or volumes."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import torch
import xarray as xr

import lidar_mi.plots  # noqa: F401 - data.lidar.plot()
from lidar_mi.flags import REJECTED, Flag, flag_attributes
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows

COMPONENTS = {"x": "u", "y": "v", "z": "w"}
"""Wind along each axis."""

_STANDARD_NAMES = {"u": "x_wind", "v": "y_wind", "w": "upward_air_velocity"}
_DIRECTIONS = {
    "x": ("ahead", {"axis": "X"}),
    "z": ("up", {"axis": "Z", "positive": "up"}),
    "y": ("left", {"axis": "Y"}),
}

Variable = tuple[Sequence[str], np.ndarray, dict[str, Any]]
"""Dims, values and attributes."""


def spacing(image: xr.DataArray) -> tuple[float, ...]:
    """Spacing of the pixels along every dim, m."""
    nodes = [image.coords.variables[axis].values.astype(float) for axis in image.dims]
    return tuple(float((n[-1] - n[0]) / (len(n) - 1)) for n in nodes)


def field(
    axes: Sequence[str], values: np.ndarray | torch.Tensor, long_name: str, units: str, **more: str
) -> Variable:
    """A variable in single precision."""
    values = values.cpu().numpy() if isinstance(values, torch.Tensor) else values
    attrs = {"long_name": long_name, "units": units, **more}
    return tuple(axes), values.astype(np.float32), attrs


def centres(image: xr.DataArray, windows: Windows, what: str) -> dict[str, Variable]:
    """Coordinates of the windows' centres, m."""
    coords: dict[str, Variable] = {}
    for number, axis in enumerate(map(str, image.dims)):
        pixel = image.coords.variables[axis].values.astype(float)
        start = np.asarray(windows.starts(number))
        place = (pixel[start] + pixel[start + windows.template - 1]) / 2
        direction, about = _DIRECTIONS[axis]
        about = {"long_name": f"{what} centre, {direction}", "units": "m", **about}
        coords[axis] = (axis,), place, about
    return coords


def winds(
    displacement: Displacement, axes: Sequence[str], steps: Sequence[float], dt: float | np.ndarray
) -> dict[str, Variable]:
    """Every component with its standard error and the correlations of their errors (m/s, 1).

    Standard errors and correlations are NaN where there is no displacement or the method gives
    none.

    axes: of its components.
    steps: pixel spacing along them, m.
    dt: of all vectors or of each, s.
    """
    names = {COMPONENTS[axis]: (number, axis) for number, axis in enumerate(axes)}
    names = dict(sorted(names.items()))
    nothing = torch.full_like(displacement.d[0], torch.nan)
    dims = len(axes)
    covariance = nothing.expand(dims, dims, *nothing.shape)
    if displacement.covariance is not None:
        covariance = torch.where(displacement.d[0].isnan(), torch.nan, displacement.covariance)
    root = covariance.diagonal().sqrt().movedim(-1, 0)
    variables = {}
    for name, (number, axis) in names.items():
        variables[name] = field(
            axes,
            displacement.d[number].cpu().numpy() * steps[number] / dt,
            f"wind along {axis}",
            "m s-1",
            standard_name=_STANDARD_NAMES[name],
        )
    for name, (number, _) in names.items():
        variables[f"{name}_stderr"] = field(
            axes,
            root[number].cpu().numpy() * steps[number] / dt,
            f"standard error of {name}",
            "m s-1",
            standard_name=f"{_STANDARD_NAMES[name]} standard_error",
        )
    for first, second in combinations(names, 2):
        a, b = names[first][0], names[second][0]
        product = root[a] * root[b]
        correlation = torch.where(product == 0, 0.0, covariance[a, b] / product)
        long_name = f"correlation of the errors of {first} and {second}"
        variables[f"{first}{second}_correlation"] = field(axes, correlation, long_name, "1")
    return variables


def flags(displacement: Displacement, axes: Sequence[str]) -> Variable:
    """The flag with its CF attributes."""
    about = flag_attributes(Flag, REJECTED)
    return tuple(axes), displacement.flag.cpu().numpy().astype(np.uint16), about


def dataset(
    variables: Mapping[str, Variable],
    coords: Mapping[str, Variable],
    title: str,
    attributes: Mapping[str, object],
    displacement: Displacement,
) -> xr.Dataset:
    """The data set, with the scalar quantities of the result."""
    attrs = {"Conventions": "CF-1.11", "title": title, **attributes, "dt_units": "s"}
    # all at once: each variable that a data set takes later copies and aligns it again
    scalars: dict[str, Any] = {}
    for name, quantity in displacement.quantities.items():
        about: dict[str, str | float] = {"long_name": quantity.long_name, "units": quantity.units}
        scalars[name] = (), quantity.value, about
        about = about | {"long_name": f"standard error of {quantity.long_name}"}
        if quantity.per_rotation:
            about["per_rotation"] = quantity.per_rotation
        scalars[f"{name}_stderr"] = (), quantity.stderr, about
    result = xr.Dataset({**variables, **scalars}, coords, attrs)
    result.attrs.update(displacement.attributes)
    for axis in result.dims:
        result.variables[axis].encoding["_FillValue"] = None
    return result
