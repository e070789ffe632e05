"""Fields averaged over the depth of planar gates."""

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError


def slab_mean(field: xr.DataArray, gates: tuple[float, float]) -> xr.DataArray:
    """Mean over the depth of planar gates, (..., z, y); linear between planes, as rendered."""
    x = field["x"].values
    weights = np.ones(1)
    if len(x) > 1:
        half = (x[1] - x[0]) / 2
        first, last = x[0] - half, x[-1] + half
        if gates[0] < first - 1e-6 or gates[1] > last + 1e-6:
            raise InputError(
                f"scan.thickness: gates from {gates[0]:g} to {gates[1]:g} m reach beyond the wake, "
                f"whose planes fill {first:g} to {last:g} m; expected gates inside"
            )
        nodes = np.unique([*gates, *x[(x > gates[0]) & (x < gates[1])]])
        linear = [np.interp(nodes, x, plane) for plane in np.eye(len(x))]
        weights = scipy.integrate.trapezoid(linear, nodes) / (gates[1] - gates[0])
    image = (field * xr.DataArray(weights, dims="x")).sum("x").transpose(..., "z", "y")
    image.attrs = field.attrs
    for axis in ("y", "z"):
        image[axis].attrs["units"] = "m"
    return image
