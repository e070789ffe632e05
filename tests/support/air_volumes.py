"""Volumes of air for tests."""

import numpy as np
import xarray as xr


def sampled(field, wind=(0.0, 0.0), shear=0.0, x=(100.0, 220.0), y=(-40.0, 40.0), z=(30.0, 90.0)):
    """Turbulence on nodes 2 m apart, in a uniform wind (u, v) and a shear du/dz from z = 60 m."""
    axes = {
        name: np.arange(low, high + 1e-9, 2.0)
        for name, (low, high) in zip("xyz", (x, y, z), strict=True)
    }
    places = np.meshgrid(*axes.values(), indexing="ij")
    u, v, w = field.velocity(*places, 0.0)
    u = u + wind[0] + shear * (places[2] - 60.0)
    values = {"u": u, "v": v + wind[1], "w": w}
    return xr.Dataset(
        {name: (("x", "y", "z"), value, {"units": "m s-1"}) for name, value in values.items()},
        {name: (name, axis, {"units": "m"}) for name, axis in axes.items()},
    )
