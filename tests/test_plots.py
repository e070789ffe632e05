"""Plots of winds, scans and flights. Unit tier.

Detects: a vector drawn where it is not, a flagged one that looks like others, a mirrored view, an
image of another layer, an angle in radians, and a plot of what has more dimensions than a plane.
"""

import subprocess
import sys

import matplotlib

matplotlib.use("agg")

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgba
from matplotlib.quiver import Quiver

import lidar_mi as lm
from lidar_mi.plots import plot_flights
from tests.support import figure_rules

Y, Z = np.arange(-2.0, 3.0), np.arange(4.0)


@pytest.fixture
def wind():
    v = np.add.outer(10 * Z, Y)
    flag = np.zeros(v.shape, int)
    flag[1, 2] = 4
    on = ("z", "y")
    return xr.Dataset(
        {"v": (on, v), "w": (on, -v), "flag": (on, flag)}, coords={"z": Z, "y": Y}
    ).transpose("y", "z")  # the order of dims is free


def arrows(axes):
    """Arrows by colour: places and components of those that are drawn."""
    found = {}
    for one in axes.collections:
        if isinstance(one, Quiver):
            drawn = ~np.broadcast_to(one.Umask, one.U.shape)
            found[tuple(one.get_facecolor()[0])] = {
                tuple(place): (u, v)
                for place, u, v, is_drawn in zip(
                    one.get_offsets().tolist(), one.U, one.V, drawn, strict=True
                )
                if is_drawn
            }
    return found


def test_winds_are_drawn_where_they_are(wind):
    axes = wind.lidar.plot()
    assert figure_rules.faults(axes.figure) == []
    drawn = arrows(axes)
    valid, flagged = drawn[to_rgba("white")], drawn[to_rgba("0.6")]
    assert len(valid) == 19 and flagged == {(0.0, 1.0): (10.0, -10.0)}
    assert valid[2.0, 3.0] == (32.0, -32.0) and (0.0, 1.0) not in valid
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    assert (left, right) == (2, -2) and low < high
    speed = np.ma.filled(axes.collections[0].get_array(), np.nan).reshape(4, 5)
    assert speed[3, 4] == pytest.approx(np.hypot(32, 32)) and np.isnan(speed[1, 2])


def test_retrieved_winds_can_be_plotted():
    """Whatever made them; in axes of the user's."""
    image = np.random.default_rng(1).random((24, 24))
    coords = {name: (name, np.arange(24.0), {"units": "m"}) for name in "zy"}
    first, second = (
        xr.DataArray(pixels, coords, ("z", "y")) for pixels in (image, np.roll(image, 1, 1))
    )
    axes = matplotlib.figure.Figure().subplots()
    found = lm.retrieve_wind(first, second, dt=1.0, method="cc")
    assert found.lidar.plot(axes) is axes and len(arrows(axes)) == 2


@pytest.mark.parametrize(
    ("dim", "message"),
    [("source", r"choose by \.sel\(source=\.\.\.\)"), ("x", r"\.sel\(x=\.\.\.\)")],
)
def test_winds_of_several_planes_are_refused(wind, dim, message):
    with pytest.raises(lm.InputError, match=message):
        wind.expand_dims({dim: [0, 1]}).lidar.plot()


def test_a_scan_shows_what_the_detector_measured():
    on = ("z", "y")
    values = np.add.outer(Z, Y)
    scan = xr.Dataset(
        {"Y": (on, values), "Y_noisy": (on, values + 1), "S0": (("gate", *on), values[None] + 2)},
        coords={"z": Z, "y": Y},
    )
    for layer, more in ((None, 1), ("Y", 0), ("S0", 2)):
        shown = scan.lidar.plot(layer=layer).collections[0].get_array()
        assert np.array_equal(np.reshape(shown, values.shape), values + more)
    with pytest.raises(lm.InputError, match="no S5"):
        scan.lidar.plot(layer="S5")


def test_neither_winds_nor_scan():
    with pytest.raises(lm.InputError, match="no Y, nor v and w; it has a"):
        xr.Dataset({"a": 1}).lidar.plot()


def test_angles_of_flights_in_degrees():
    series = xr.Dataset(
        {
            "roll": (("flight", "time"), [[0, np.pi / 4], [0, 0.1]], {"units": "rad"}),
            "x": (("flight", "time"), [[0, 75], [0, 74]], {"units": "m", "long_name": "way"}),
        },
        coords={"flight": ["off", "own"], "time": [0.0, 1.0]},
    )
    axes = plot_flights(series)
    assert axes.lines[0].get_ydata()[1] == pytest.approx(45)
    assert axes.get_ylabel() == "roll / degrees"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["off", "own"]
    assert plot_flights(series, name="x").get_ylabel() == "way / m"


def test_matplotlib_is_loaded_by_the_first_plot():
    program = (
        "import sys, lidar_mi as lm; lm.retrieve_wind; lm.read_scan; import lidar_mi.plots; "
        "assert 'matplotlib' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
