"""Data sets as campaigns collect them, made up."""

import numpy as np
import xarray as xr

RANGE, ENERGY = [75.0, 150.0, 300.0], [1e-4, 1e-3, 1e-2, 1e-1]


def campaign(coords, dims, values, **attributes):
    """A data set as a campaign collects it; the point of the first indices has failed."""
    shape = tuple(len(coords[dim][1]) if dim in coords else 4 for dim in dims)
    error = np.broadcast_to(values, shape).astype(float).copy()
    status = np.zeros(shape, np.int8)
    status.flat[0], error.flat[0] = 1, np.nan
    places = np.array([f"points/aa/{k}" for k in range(error.size)], object).reshape(shape)
    message = np.where(status == 1, "no rings <b>detected</b>", "").astype(object)
    return xr.Dataset(
        {
            "sensor.rmse_v": (dims, error, {"units": "m/s", "long_name": "error of v"}),
            "sensor.flight_control.landing.error_v.margin": (dims, 1 - error / 2.5),
            "status": (dims, status),
            "message": (dims, message),
            "folder": (dims, places),
        },
        coords,
        {"name": "test <i>", "base": "wake_sensor", "keep": "metrics", **attributes},
    )


def sweep(members=4):
    coords = {
        "range": ("range", RANGE, {"units": "m", "long_name": "range"}),
        "energy": ("energy", ENERGY, {"units": "J", "long_name": "energy", "scale": "log"}),
    }
    # error 2.5 m/s at 3.16 mJ, whatever the range; members differ by 1 %
    error = 2.5 * np.sqrt(10**-2.5 / np.array(ENERGY))[None, :, None]
    error = error * (1 + 0.01 * np.arange(members) - 0.005 * (members - 1))
    return campaign(coords, ("range", "energy", "member"), error)
