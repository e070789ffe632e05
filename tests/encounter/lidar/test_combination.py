"""The wind of both lidars ahead of an aircraft that is off its path.

Detects: places of lines and images that are not brought together, motion along the path that is
taken for motion across it.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.encounter.lidar.combination import combined_in_flight
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, scan_wind

METRES = {"units": "m"}
Y, Z = np.arange(-20, 21, 4.0), np.arange(-12, 13, 4.0)
X, PLACE = 160.0, np.array([10.0, 3.0, -2.0])
TRUE = np.array([4.0, 1.0, -2.0])


def images(u=TRUE[0]):
    """Uniform wind as seen by images from the aircraft: u is taken for -y / x u, -z / x u."""
    y, z = np.meshgrid(Y, Z)
    away = X - PLACE[0]
    seen = {
        "v": TRUE[1] - (y - PLACE[1]) / away * u,
        "w": TRUE[2] - (z - PLACE[2]) / away * u,
        "v_stderr": 0 * y + 0.1,
        "w_stderr": 0 * y + 0.1,
        "vw_correlation": 0 * y,
        "flag": np.zeros(y.shape, np.uint8),
    }
    found = xr.Dataset(
        {name: (("z", "y"), values) for name, values in seen.items()},
        coords={"z": ("z", Z, METRES), "y": ("y", Y, METRES)},
        attrs={"template": 2, "stride": 1},
    )
    for name in ("v", "w", "v_stderr", "w_stderr"):
        found[name].attrs["units"] = "m s-1"
    return found


def lines():
    scan = DopplerScan(columns=4, rows=3, azimuth_half="6 deg", elevation_half="3.5 deg")
    lidar = DopplerLidar(range=X - PLACE[0], range_bin=2.0)
    return scan_wind(lambda points: np.broadcast_to(TRUE, points.shape), scan, lidar, 0.05, 2, 75.0)


def test_uniform_wind_is_found_at_its_places():
    found = combined_in_flight(images(), lines(), PLACE, X, None)
    np.testing.assert_array_equal(found["y"], Y)
    np.testing.assert_array_equal(found["z"], Z)
    assert found["y"].attrs == METRES
    for name, true in zip("uvw", TRUE, strict=True):
        off = (found[name] - true) / found[f"{name}_stderr"]
        assert float(abs(off).max()) < 4
    assert float(found["u_stderr"].min()) < 0.1
    # the slope that is taken off: 20 m aside, of 4 m/s at 150 m
    assert float(found["v"].std()) < 0.1 < 4.0 * 20 / 150 / np.sqrt(3)


def test_an_aircraft_aside_is_as_one_on_its_path():
    """What both lidars see depends on where the air is from the aircraft alone."""
    found = combined_in_flight(images(), lines(), PLACE, X, None)
    moved = images().assign_coords(
        {"y": ("y", Y - PLACE[1], METRES), "z": ("z", Z - PLACE[2], METRES)}
    )
    there = combined_in_flight(moved, lines(), np.array([PLACE[0], 0, 0]), X, None)
    for name in "uvw":
        np.testing.assert_allclose(found[name].values, there[name].values, atol=1e-9)
    assert float(abs(there["y"] - found["y"].values + PLACE[1]).max()) == pytest.approx(0, abs=1e-9)
