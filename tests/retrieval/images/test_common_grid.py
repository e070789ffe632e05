"""Resampling onto one grid against the analytic image.

Detects a shift of 0.01 px, swapped axes, and extrapolation beyond the image.
"""

from functools import partial

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.common_grid import on_one_grid, resample, resample_pair
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array, plane_waves, texture


def scan(field, distance, kind):
    """An image at equidistant angles in the plane x = distance, coordinates in 1-D or 2-D."""
    theta = np.radians(np.linspace(-6.2, 6.2, 219))
    phi = np.radians(np.linspace(-3.9, 3.9, 139))
    y, z = np.meshgrid(distance * np.tan(theta), distance * np.tan(phi))
    attrs = {"units": "m"}
    if kind == "1d":
        coords = {"z": ("z", z[:, 0], attrs), "y": ("y", y[0], attrs)}
        return xr.DataArray(field(y, z), coords, ("z", "y"))
    dims = ("elevation", "azimuth")
    return xr.DataArray(field(y, z), {"z": (dims, z, attrs), "y": (dims, y, attrs)}, dims)


def smooth(y, z):
    return 2 + np.sin(0.7 * y) * np.cos(0.5 * z) + 0.01 * y


@pytest.mark.parametrize("kind", ["1d", "2d"])
def test_resampled_image_is_the_field(kind):
    """Cubic spline, h = 0.5 m, k = 0.7 / m: error of order (k h)^4 / 384 = 4e-5, more at edges."""
    y, z = np.arange(-50, 50.1, 0.5), np.arange(-30, 30.1, 0.4)
    image = resample(scan(smooth, 500.0, kind), y, z)
    assert image.dims == ("z", "y") and image.y.attrs["units"] == image.z.attrs["units"] == "m"
    expected = smooth(*np.meshgrid(y, z))
    np.testing.assert_allclose(image, expected, atol=2e-4)
    # transposed input means the same
    np.testing.assert_allclose(resample(scan(smooth, 500.0, kind).T, y, z), image, atol=1e-12)


def test_own_pixels_are_kept_exactly():
    image = scan(smooth, 485.0, "1d")
    np.testing.assert_allclose(resample(image, image.y.values, image.z.values), image, atol=1e-12)


def test_outside_is_nan():
    image = scan(smooth, 500.0, "1d")
    edge = float(image.y[-1])
    inside = resample(image, np.array([0.0, edge, edge + 0.01]), np.array([0.0, 1.0]))
    assert np.isfinite(inside.values[:, :2]).all() and np.isnan(inside.values[:, 2]).all()


@pytest.mark.slow
def test_pair_at_two_distances_stands_still():
    """The same air seen from 500 m and 485 m: without one grid 0.7 m off at the edge (7 m/s)."""

    field = partial(texture, plane_waves(1, 6.0, 0.5))

    first, second = resample_pair(scan(field, 500.0, "2d"), scan(field, 485.0, "2d"), 0.5)
    assert first.shape == second.shape == (133, 211)
    half = 485 * np.tan(np.radians(6.2))
    assert float(first.y[-1]) == np.floor(half / 0.5) * 0.5
    # spline errors differ between the two: texture of 6 px correlation length loses 1e-4
    np.testing.assert_allclose(first, second, atol=2e-3)
    wind = retrieve_wind(first, second, 0.1, windows=WindowSizes(stride=4))
    assert float(np.abs(wind.displacement_y).max()) < 0.25  # within the pixel: the fit's own error
    assert abs(float(wind.v.mean())) < 0.1 and abs(float(wind.w.mean())) < 0.1


def test_bad_input_is_named():
    image = scan(smooth, 500.0, "1d")
    nodes = np.arange(-5.0, 5.0)
    tilted = scan(smooth, 500.0, "2d")
    tilted = tilted.assign_coords(y=tilted.y + 0.1 * tilted.z)
    holed = image.copy()
    holed[3, 3] = np.nan
    for call, start in (
        (lambda: resample(image.drop_vars("y"), nodes, nodes), "image.y: coordinate missing"),
        (lambda: resample(tilted, nodes, nodes), "image.y: varies along both dims"),
        (lambda: resample(image[:, ::-1], nodes, nodes), "image.y: not at least two"),
        (lambda: resample(holed, nodes, nodes), "image: 1 of 30441 pixels"),
        (lambda: resample(image[:3], nodes, nodes), "image: (3, 219) px are too few"),
        (lambda: resample(image, nodes[::-1], nodes), "y: nodes"),
        (lambda: resample(image, nodes, nodes + 1000), "z: nodes 995 ... 1004 m are all outside"),
        (lambda: resample(image.expand_dims("gate"), nodes, nodes), "image: dims"),
        (lambda: resample_pair(image, image, 0.0), "spacing: 0.0 m"),
        (lambda: resample_pair(image[:, :50], image[:, 100:], 0.5), "image2.y:"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value).startswith(start) and "\n" not in str(error.value)


def test_axes_of_another_order_are_the_same_image():
    y, z = np.arange(30.0), np.arange(24.0)
    image = xr.DataArray(np.random.default_rng(3).random((24, 30)), {"z": z, "y": y}, ("z", "y"))
    first, second = on_one_grid(image, image.T)
    xr.testing.assert_identical(first, image)
    xr.testing.assert_identical(second, image)


def test_gaps_stay_gaps():
    """Nodes beside a pixel without value have none, all others that of an image without gaps."""
    y, z = axes(60, 50)
    waves = plane_waves(3, 3.0, 0.5)
    near, far = (
        data_array(texture(waves, *np.meshgrid(s * y, s * z)), s * y, s * z) for s in (0.97, 1.0)
    )
    holed = near.where(near["y"] > -13.0)
    found, _ = resample_pair(holed, far, 0.5)
    whole, _ = resample_pair(near, far, 0.5)
    assert found.where(found["y"] < -13.0, drop=True).isnull().all()
    assert found.where(found["y"] > -12.4, drop=True).notnull().all()
    further = found["y"] > -8.0
    np.testing.assert_allclose(
        found.where(further, drop=True), whole.where(further, drop=True), atol=1e-3
    )
