"""Winds of scans in which every pixel has its own time.

Detects a wrong sign or axis of the time difference, a time of the wrong place (1 % of a
displacement further on). `validation.timing` has the winds.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.beam_times import vector_times
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array
from tests.support.timed import DT, DURATION, scan_times, uniform_wind

SIZE = (90, 70)
V, W = 6.0, 12.0
# of a raster and, but for its turns, of a serpentine, s/m along y and z
SLOPE = DURATION / (SIZE[0] * SIZE[1] - 1) * np.array([1.0, SIZE[0]]) / 0.5


@pytest.mark.parametrize("method", ["cc", "ws"])
def test_vectors_of_window_methods(method):
    """The same displacement over the time of the closed form, errors alike, at its mid-time."""
    images, times = uniform_wind("raster", V, W, SIZE)
    found = retrieve_wind(*images, DT, method, times=times, checks=False)
    photographs = retrieve_wind(*images, DT, method, checks=False)
    d = [photographs[f"displacement_{axis}"].values for axis in "yz"]
    difference = DT + SLOPE[0] * d[0] + SLOPE[1] * d[1]
    names = ("v", "w") if method == "ws" else ("v", "w", "v_stderr", "w_stderr")
    for name in names:
        np.testing.assert_allclose(found[name], photographs[name] * DT / difference, rtol=1e-5)
    place = [found[f"{axis}_vector"].values for axis in "yz"]
    expected = DT / 2 + SLOPE[0] * place[0] + SLOPE[1] * place[1]
    with_place = np.isfinite(expected)
    np.testing.assert_allclose(found["time"].values[with_place], expected[with_place], atol=1e-7)
    assert found["time"].attrs["units"] == "s"


@pytest.mark.parametrize("centred", [True, False])
def test_time_difference_of_unlike_scans(centred):
    """Times linear in place, different in both scans: by hand."""
    shape = (30, 40)
    z, y = np.mgrid[:30, :40]
    first, second = 1e-4 * z - 2e-5 * y, 3e-4 * y + 1e-3
    windows = Windows(shape, 7, 15, 3)
    d = np.random.default_rng(1).uniform(-3, 3, (2, *windows.count))
    found = vector_times([first, second], DT, windows, d, centred)
    centre = np.stack(np.meshgrid(*(windows.centres(a) for a in (0, 1)), indexing="ij"))
    p1 = centre - d / 2 if centred else centre
    p2 = p1 + d
    tau1, tau2 = 1e-4 * p1[0] - 2e-5 * p1[1], 3e-4 * p2[1] + 1e-3
    np.testing.assert_allclose(found.difference, DT + tau2 - tau1, rtol=1e-12)
    np.testing.assert_allclose(found.middle, (tau1 + DT + tau2) / 2, rtol=1e-12)


def test_a_serpentine_is_averaged_over_the_template():
    """Turns alternate from row to row by 1.4 ms; half a template later nothing of it is left."""
    tau = scan_times("serpentine", 70, 90)
    windows = Windows(tau.shape, 8, 16, 1)
    found = vector_times([tau, tau], DT, windows, np.zeros((2, *windows.count)), True)
    row = windows.centres(0).numpy()[:, None]
    smooth = DURATION * ((row + 0.5) / 70 - 0.5) + DT / 2
    np.testing.assert_allclose(found.middle - smooth, 0, atol=1e-5)


@pytest.mark.parametrize("method", ["cc", "ws", "multipass"])
def test_times_of_zero_change_nothing(method):
    images, _ = uniform_wind("photograph", 4.0, 3.0, (50, 40))
    none = [xr.zeros_like(image) for image in images]
    found = retrieve_wind(*images, DT, method, times=none)
    photographs = retrieve_wind(*images, DT, method)
    xr.testing.assert_identical(found, photographs)
    assert (found["time"] == np.float32(DT / 2)).all()


def test_pixels_without_value_need_no_time():
    """Beyond the beams of a gridded scan there is neither; vectors elsewhere do not change."""
    images, times = uniform_wind("raster", V, W, SIZE)
    beyond = images[0]["y"] > 18.0
    holed = [image.where(~beyond) for image in images]
    without = [time.where(~beyond) for time in times]
    found = retrieve_wind(*holed, DT, "cc", times=without)
    whole = retrieve_wind(*images, DT, "cc", times=times)
    apart = found["y"] < 10.0
    np.testing.assert_allclose(found["v"].where(apart), whole["v"].where(apart), rtol=1e-5)
    assert np.isfinite(found["time"]).all()


def test_bad_times():
    images, times = uniform_wind("raster", V, W, (40, 40))
    y, z = axes(40, 40, 0.6)
    missing = times[0].copy()
    missing[3, 4] = np.nan
    cases = [
        (times[:1], "times: 1 for 2 images are not allowed; expected those of two images"),
        ([times[0], times[0][1:]], "times[1]: sizes 40 x 40 and 39 x 40 px"),
        ([times[0], data_array(times[0].values, y, z)], "times[1].z: up to 1.95 m off"),
        ([missing, times[1]], "times[0]: 1 pixels are not finite"),
        ([times[0] + 1, times[1]], "times: dt = 0.1 s is not allowed"),
    ]
    for given, message in cases:
        with pytest.raises(InputError) as error:
            retrieve_wind(*images, DT, times=given)
        assert str(error.value).startswith(message), str(error.value)
    with pytest.raises(InputError, match="times: not allowed with 3 images"):
        retrieve_wind(*images, DT, "variational", times=times, more=[images[1]])
