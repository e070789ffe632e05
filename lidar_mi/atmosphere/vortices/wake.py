"""Simulated wakes: refined to a finer grid and put into the lidar's frame."""

import math
from collections.abc import Mapping

import numpy as np
import scipy
import xarray as xr

from lidar_mi.atmosphere.regrid import interpolated, statement
from lidar_mi.errors import InputError

MOST_NODES = 10**8

# largest deviation of the extent from a whole number of cells, in cells: axes of files are even to
# this
_UNEVEN = 1e-3


def check_nodes(spacing: float, counts: Mapping[str, int], most: int = MOST_NODES) -> None:
    """Whether as many nodes along each axis fit into memory, several fields of them.

    Raises InputError: more than ``most`` nodes. 1e8 take 0.8 GB per field.
    """
    if math.prod(counts.values()) > most:
        counted = " x ".join(f"{count} ({name})" for name, count in counts.items())
        raise InputError(
            f"wake.spacing: {spacing:g} m is not allowed, it makes {counted} nodes; expected at "
            f"most {most:g} nodes, which memory holds with all that is made of them"
        )


def resample(
    wake: xr.Dataset, spacing: float, axes: str = "yz", most: int = MOST_NODES
) -> xr.Dataset:
    """Finer nodes by cubic splines, in y and z unless other axes are named.

    Splines (not-a-knot) along one axis after the other, through the nodes; exact for cubic
    polynomials. Where the spacing divides the extent, the end nodes are kept: 110 x 70 nodes of 1 m
    become 219 x 139 of 0.5 m. Elsewhere the nodes lie about the middle of the extent, within it,
    and the attribute ``interpolated`` states with which error. tracer and aerosol are clipped to
    the range of their data, which a spline exceeds at sharp edges (a tracer would go negative
    there). The spacing (m) is at most the extent; ``most`` nodes are allowed.

    Raises InputError: a spacing that is not positive, is larger than an extent or gives too many
    nodes, fewer than 4 nodes.
    """
    if not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"wake.spacing: {spacing} m is not allowed; it must be > 0 m")
    ends, divided = {}, True
    for name in axes:
        places = wake[name].values.astype(float)
        if places.size < 4:
            raise InputError(
                f"wake.{name}: {places.size} nodes are too few to interpolate; allowed: 4 or more"
            )
        extent = places[-1] - places[0]
        cells = round(extent / spacing)
        margin = 0.0
        if abs(cells * spacing - extent) > _UNEVEN * spacing:
            cells, divided = math.floor(extent / spacing), False
            margin = (extent - cells * spacing) / 2
        if cells < 1:
            raise InputError(
                f"wake.spacing: {spacing:g} m is not allowed; expected at most the extent of "
                f"{name}, {extent:g} m"
            )
        ends[name] = (places[0] + margin, places[-1] - margin, cells + 1)
    # before anything of this size is allocated
    check_nodes(spacing, {d: ends[d][2] if d in ends else wake.sizes[d] for d in "xyz"}, most)
    nodes = {name: np.linspace(*end) for name, end in ends.items()}

    fine = wake.drop_vars([*wake.data_vars, *axes]).assign_coords(
        {name: (name, values, {"units": "m"}) for name, values in nodes.items()}
    )
    old = [wake[axis].values.astype(float) for axis in "xyz"]
    targets = [nodes.get(axis, same) for axis, same in zip("xyz", old, strict=True)]
    errors = {}
    for variable_name, variable in wake.data_vars.items():
        field = variable.transpose("x", "y", "z").values.astype(float)
        values = field
        if divided:
            for axis in axes:
                values = scipy.interpolate.CubicSpline(
                    wake[axis].values, values, axis="xyz".index(axis)
                )(nodes[axis])
        else:
            values, errors[str(variable_name)] = interpolated(field, old, targets)
        if variable_name in ("tracer", "aerosol"):
            values = values.clip(field.min(), field.max())
        fine[variable_name] = ("x", "y", "z"), values, variable.attrs
    units = {name: wake[name].attrs.get("units", "") for name in errors}
    notes = [wake.attrs.get("interpolated", ""), statement(errors, units)]
    if any(notes):
        fine.attrs["interpolated"] = ", then ".join(filter(None, notes))
    return fine


def centre(
    wake: xr.Dataset,
    y: float | None = None,
    z: float | None = None,
    about: tuple[float, float] = (0.0, 0.0),
) -> xr.Dataset:
    """Translate the wake: its point (y, z) to `about` in the lidar frame, by default the beam axis.

    y, z: m, in the wake's own frame and inside it; default: the middle of the domain.
    about: y and z in the lidar frame, m.

    Raises InputError: a centre outside the wake.

    Returns
    -------
    xarray.Dataset
        The same values on shifted axes.
    """
    shifted = wake
    for name, place, target in (("y", y, about[0]), ("z", z, about[1])):
        axis = wake[name]
        first, last = float(axis[0]), float(axis[-1])
        if place is None:
            place = (first + last) / 2
        elif not first <= place <= last:
            raise InputError(
                f"wake.centre.{name}: {place:g} m is outside the wake; allowed: "
                f"{first:g} to {last:g} m"
            )
        moved = axis.values - place + target
        shifted = shifted.assign_coords({name: (name, moved, axis.attrs)})
    return shifted
