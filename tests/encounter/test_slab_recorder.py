"""What the lidar saw, kept for figures.

Detects: images of another slab, vectors that are flagged but shown, grids that shift with the
aircraft, memory spent where nothing was seen.
"""

from types import SimpleNamespace

import numpy as np
import xarray as xr

from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.encounter.slab_recorder import SlabRecorder


def estimate(x, shift=0.0, wind=True):
    """An estimate whose v is y + 2 z, on nodes that are shifted along y; the last is flagged."""
    y, z = np.linspace(-30, 30, 61) + shift, np.linspace(-10, 10, 21)
    v = y + 2 * z[:, None]
    flag = np.zeros(v.shape, int)
    flag[-1] = 4
    parts = {"v": (("z", "y"), v), "w": (("z", "y"), -v), "flag": (("z", "y"), flag)}
    found = xr.Dataset(parts, {"z": z, "y": y}) if wind else None
    return Estimate(1.0, 1.1, x, found, None, (), {})


def image(shift=0.0):
    y, z = np.linspace(-30, 30, 61) + shift, np.linspace(-10, 10, 21)
    return SimpleNamespace(first=xr.DataArray(y * z[:, None], {"z": z, "y": y}, ("z", "y")))


def test_slabs_share_the_grid_of_the_first():
    lidar = SimpleNamespace(images=image())
    recorder = SlabRecorder(lidar)
    recorder.add(estimate(75.0))
    lidar.images = image(0.5)
    recorder.add(estimate(82.5, 0.5))
    found = recorder.dataset()
    assert found.sizes["slab"] == 2 and list(found["x"].values) == [75.0, 82.5]
    inside = found.isel(slab=1, y=slice(1, -1), z=slice(0, -1))
    # linear functions are interpolated exactly, in single precision
    assert np.abs(inside["v"] - inside["y"] - 2 * inside["z"]).max() < 1e-4
    shown = found["image"].isel(slab=1, image_y=slice(1, None))
    assert np.abs(shown - shown["image_z"] * shown["image_y"]).max() < 1e-3
    assert found["v"].dtype == np.float32 and found.sizes["y"] <= 31


def test_flagged_vectors_are_not_shown():
    recorder = SlabRecorder(SimpleNamespace())
    recorder.add(estimate(75.0))
    wind = estimate(75.0).wind
    found = recorder.dataset().isel(slab=0)
    kept = wind.sel(y=found["y"], z=found["z"])
    assert (np.isnan(found["v"]) == (kept["flag"] != 0)).all() and "image" not in found


def test_nothing_seen_is_nothing_kept():
    recorder = SlabRecorder(SimpleNamespace(images=None))
    recorder.add(estimate(75.0, wind=False))
    assert recorder.dataset() is None


def test_slabs_without_a_wind_have_images():
    """The computer may have skipped the wind of any slab, the first one too."""
    recorder = SlabRecorder(SimpleNamespace(images=image()))
    for x, wind in ((75.0, False), (82.5, True), (90.0, False)):
        recorder.add(estimate(x, wind=wind))
    found = recorder.dataset()
    assert np.isfinite(found["v"]).any(("z", "y")).values.tolist() == [False, True, False]
    assert np.isfinite(found["image"]).all()
