"""The flights of an encounter without images: time series and track, made-up slabs."""

import functools

import numpy as np
import xarray as xr

from lidar_mi.encounter.flight import FlightData, simulate_flights
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import SyntheticLidar, encounter_keys


@functools.cache
def made_up_flights() -> FlightData:
    """A short flight with a synthetic lidar, and images of noise."""
    one = check(encounter_keys(path={"start": "90 m", "beyond": "30 m"}), "test")
    found = simulate_flights(one, silent, lidar=SyntheticLidar(wake_along_path(one)))
    track = found.track
    random, slabs = np.random.default_rng(1), track.sizes["slab"]
    axes = {"y": np.arange(-20, 21, 5.0), "z": np.arange(-10, 11, 5.0)}
    fine = {"image_y": np.arange(-24, 25, 1.0), "image_z": np.arange(-14, 15, 1.0)}
    shape = slabs, len(axes["z"]), len(axes["y"])
    views = xr.Dataset(
        {
            "image": (
                ("slab", "image_z", "image_y"),
                random.normal(size=(slabs, len(fine["image_z"]), len(fine["image_y"]))),
            ),
            "v": (("slab", "z", "y"), random.normal(size=shape)),
            "w": (("slab", "z", "y"), random.normal(size=shape)),
            **{name: ("slab", track[name].values) for name in ("time", "x", "delivered")},
        },
        {**axes, **fine},
    )
    return FlightData(found.series, track, views)
