"""Images of one instant from scans that take time.

Detects values of air at different times that are averaged: winds 1 m/s off.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.retrieval.images.common_grid import on_one_grid
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.synchronised import advected, mixes_times, synchronised
from tests.support.flows import axes, data_array, plane_waves, texture

DT, V, W = 0.1, 6.0, 12.0
Y, Z = axes(60, 48)
SIZE = Y.size * Z.size
WAVES = plane_waves(3, 4.0, 0.5)


def lissajous(duration):
    """Times and places of as many beams as there are nodes: cycles 41 to 32, beyond the rim."""
    phase = np.arange(SIZE) / SIZE
    time = duration * (phase - 0.5)
    y, z = (1.05 * np.ptp(a) / 2 * np.sin(2 * np.pi * n * phase) for a, n in ((Y, 41), (Z, 32)))
    return (part.reshape(Z.size, Y.size) for part in (time, y, z))


def scan(time, y, z, at, v=V, w=W):
    """What beams see of a texture that a uniform wind carries, the reference time at ``at``."""
    seen = texture(WAVES, y - v * (at + time), z - w * (at + time))
    fields = {"Y": seen, "beam_time": time, "y_reported": y, "z_reported": z}
    return xr.Dataset({name: data_array(field, Y, Z) for name, field in fields.items()})


@pytest.mark.slow
def test_wind_of_a_curve_that_crosses_itself():
    """Air moves by 2 px during the scan: values of one place are of different air.

    The mean of some 20 independent windows, whose scatter gives the tolerance.
    """
    scans = [scan(*lissajous(0.09), at) for at in (0.0, DT)]
    images = synchronised(scans, [DT], "Y")
    assert all(image["beam_time"].max() == image["beam_time"].min() for image in images)
    mixed = [on_nodes(one, errors=False) for one in scans]
    found, wrong = (
        retrieve_wind(
            *(i["Y"] for i in pair),
            DT,
            "multipass",
            windows=WindowSizes(stride=4),
            standard_errors=False,
        )
        for pair in (images, mixed)
    )
    for name, true in (("v", V), ("w", W)):
        valid = found[name].where(found["flag"] == 0)
        assert abs(float(valid.mean()) - true) < 3 * float(valid.std()) / np.sqrt(20)
        assert float(valid.std()) < 0.1
    off = np.hypot(wrong["v"] - V, wrong["w"] - W).where(wrong["flag"] == 0)
    assert float(off.mean()) > 1.0


@pytest.mark.slow
def test_scans_by_angles_from_a_platform_that_moves():
    """Nodes of the second scan are 3 % nearer to each other."""
    first, second = scan(*lissajous(0.09), 0.0), scan(*lissajous(0.09), DT)
    nearer = second.assign_coords({a: (a, 0.97 * second[a].values, {"units": "m"}) for a in "zy"})
    images = synchronised([first, nearer], [DT], "Y")
    np.testing.assert_array_equal(images[1]["y"], nearer["y"])
    pair = on_one_grid(*(image["Y"] for image in images))
    found = retrieve_wind(
        *pair, DT, "multipass", windows=WindowSizes(stride=4), standard_errors=False
    )
    for name, true in (("v", V), ("w", W)):
        valid = found[name].where(found["flag"] == 0)
        independent = float(valid.count()) * 4**2 / 8**2
        assert abs(float(valid.mean()) - true) < 3 * float(valid.std()) / np.sqrt(independent)


def test_times_that_are_linear_in_place_are_not_mixed():
    """A raster's are, those of a curve are not unless it is over at once; frozen air has none."""
    y, z = np.meshgrid(Y, Z)
    raster = scan(0.09 * (np.arange(SIZE).reshape(y.shape) / SIZE - 0.5), y + 0.2, z, 0.0)
    assert not mixes_times(raster, DT)
    curve = scan(*lissajous(0.09), 0.0)
    assert mixes_times(curve, DT) and not mixes_times(scan(*lissajous(1e-4), 0.0), DT)
    assert not mixes_times(curve.assign_attrs(frozen_air=1), DT)
    assert not mixes_times(curve.drop_vars("beam_time"), DT)


@pytest.mark.slow
def test_scans_that_mix_no_times_are_only_resampled():
    y, z = np.meshgrid(Y, Z)
    time = 0.05 * (np.arange(SIZE).reshape(y.shape) / SIZE - 0.5)
    scans = [scan(time, y + 0.2, z - 0.1, at) for at in (0.0, DT)]
    for one, expected in zip(synchronised(scans, [DT], "Y"), scans, strict=True):
        xr.testing.assert_identical(one, on_nodes(expected))


@pytest.mark.parametrize("rate", [2.0, -4.0])
def test_beams_are_carried_along_circles(rate):
    """Rigid rotation turns a place by rate x time: the midpoint rule errs by (rate t)^3 / 6 r."""
    time, y, z = lissajous(0.09)
    before = advected(scan(time, y, z, 0.0), lambda p: rate * np.stack([-p[..., 1], p[..., 0]], -1))
    turn, radius = -rate * time, np.hypot(y, z)
    expected = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
    limit = np.abs(turn) ** 3 / 6 * radius * 1.01 + 1e-12
    for name, right in zip(("y_reported", "z_reported"), expected, strict=True):
        assert (np.abs(before[name].values - right) <= limit).all()
    assert limit.max() < 0.02
