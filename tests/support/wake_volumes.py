"""A simulated volume that is known in closed form: a deformed pair, sampled on a grid."""

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.wake_path import CROW_WAVELENGTH, PairAlongPath

SEPARATION = 24.0


def crow_volume(waves: int, amplitude: float, planes: int = 52) -> xr.Dataset:
    """Whole waves of a pair of 300 m^2/s with exhaust about its cores, on (x, y, z), about 0."""
    pair = PairAlongPath(300.0, SEPARATION, crow_amplitude=amplitude)
    wave = CROW_WAVELENGTH * SEPARATION
    x = np.arange(waves * planes) * (wave / planes)
    y, z = np.arange(-35.0, 35.5, 1.0), np.arange(-25.0, 25.5, 1.0)
    places = np.meshgrid(x, y, z, indexing="ij")
    wind = pair.wind(*places, 0.0)
    tracer = np.zeros(places[0].shape)
    for k, one in enumerate(x):
        for vortex in pair.vortices(one, 0.0):
            r2 = (places[1][k] - vortex.y) ** 2 + (places[2][k] - vortex.z) ** 2
            tracer[k] += np.exp(-r2 / 50.0)
    dims = ("x", "y", "z")
    fields = {name: (dims, a, {"units": "m s-1"}) for name, a in zip("uvw", wind, strict=True)}
    fields["tracer"] = dims, tracer, {"units": "1"}
    fields["extinction"] = dims, 1e-4 + 1.7e-3 * tracer / tracer.max(), {"units": "m-1"}
    axes = {name: (name, a, {"units": "m"}) for name, a in zip("xyz", (x, y, z), strict=True)}
    return xr.Dataset(fields, axes)
