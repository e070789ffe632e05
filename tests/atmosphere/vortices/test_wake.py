"""Refining and placing a wake: unit tests. Detect a node or a field that is off by 1e-9."""

from importlib.resources import files

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.wake import centre, resample
from lidar_mi.errors import InputError
from lidar_mi.io.wake_file import read_wake

SLAB = files("lidar_mi.scenes") / "wake_slab_40s.nc"


def test_resample_has_the_papers_219_by_139_nodes_and_keeps_the_old_ones():
    wake = read_wake(SLAB, time=40.0)
    fine = resample(wake, 0.5)
    assert fine.v.shape == (1, 219, 139) and fine.v.dims == ("x", "y", "z")
    assert (float(fine.y[0]), float(fine.y[-1])) == (-54.5, 54.5)
    for name in wake.data_vars:
        np.testing.assert_allclose(fine[name][:, ::2, ::2], wake[name], atol=1e-12)
    assert float(fine.tracer.min()) >= 0
    assert float(fine.tracer.max()) <= float(wake.tracer.max())


def test_resample_is_exact_for_cubics():
    y, z = np.arange(8.0), np.arange(7.0) * 2
    polynomial = np.poly1d([0.3, -2, 1, 5])

    def plane(y, z):
        return polynomial(y)[:, None] * polynomial(z / 3)[None, :]

    wake = xr.Dataset({"v": (("x", "y", "z"), plane(y, z)[None])}, {"x": [0.0], "y": y, "z": z})
    fine = resample(wake, 0.25)
    np.testing.assert_allclose(fine.v[0], plane(fine.y.values, fine.z.values), rtol=1e-9, atol=1e-9)


def test_resample_by_a_spacing_that_does_not_divide_the_extents():
    """Nodes of that spacing about the middle of the extent; exact for cubics, with an error."""
    y, z = np.arange(12.0), 3 + np.arange(9.0)
    polynomial = np.poly1d([0.3, -2, 1, 5])

    def plane(y, z):
        return polynomial(y)[:, None] * polynomial(z / 3)[None, :]

    units = {"units": "m s-1"}
    wake = xr.Dataset(
        {"v": (("x", "y", "z"), plane(y, z)[None], units)}, {"x": [0.0], "y": y, "z": z}
    )
    fine = resample(wake, 0.7)
    for name, own, count in (("y", y, 16), ("z", z, 12)):
        nodes = fine[name].values
        np.testing.assert_allclose(np.diff(nodes), 0.7, rtol=1e-12)
        assert nodes.size == count and own[0] <= nodes[0] and nodes[-1] <= own[-1]
        assert nodes[0] + nodes[-1] == pytest.approx(own[0] + own[-1])
    np.testing.assert_allclose(fine.v[0], plane(fine.y.values, fine.z.values), rtol=1e-9, atol=1e-9)
    assert fine.attrs["interpolated"].startswith("interpolated to an even grid: v to ")
    # where one extent is divided, its end nodes are kept
    assert (resample(wake.isel(z=slice(0, 8)), 0.7).z[[0, -1]] == z[[0, 7]]).all()
    assert "interpolated" not in resample(wake, 0.5).attrs


def test_resample_keeps_a_sharp_tracer_positive():
    y = np.arange(10.0)
    step = np.where(y < 5, 0.0, 1.0)[:, None] * np.ones(6)
    dims = ("x", "y", "z")
    wake = xr.Dataset(
        {"tracer": (dims, step[None]), "v": (dims, step[None])},
        {"x": [0.0], "y": y, "z": np.arange(6.0)},
    )
    fine = resample(wake, 0.5)
    assert float(fine.v.min()) < -0.01  # the spline does swing
    assert float(fine.tracer.min()) == 0 and float(fine.tracer.max()) == 1


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, 200.0])
def test_resample_bad_spacing(spacing):
    with pytest.raises(InputError, match=r"wake.spacing"):
        resample(read_wake(SLAB, time=40.0), spacing)


def test_resample_needs_four_nodes():
    wake = read_wake(SLAB, time=40.0).isel(y=slice(0, 3))
    with pytest.raises(InputError, match=r"wake.y: 3 nodes"):
        resample(wake, 0.5)


def test_centre():
    wake = read_wake(SLAB, time=40.0)
    middle = centre(wake)
    assert float(middle.z[0]) == -34.5 and float(middle.z[-1]) == 34.5
    shifted = centre(wake, y=-1.0, z=-60.0, about=(0.0, 5.0))
    assert float(shifted.y[0]) == -53.5 and float(shifted.z[0]) == -94.5 + 65
    xr.testing.assert_equal(shifted.v.variable, wake.v.variable)
    assert shifted.y.attrs["units"] == "m"
    with pytest.raises(InputError, match=r"centre.z"):
        centre(wake, z=0.0)
