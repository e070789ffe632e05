"""Plots of winds, scans and flights. Unit tier.

Detects: a vector drawn where it is not, a flagged one that looks like others, a mirrored view, an
image of another layer, an angle in radians, a plot of what has more dimensions than a plane, arrows
too short to be seen in a large plane, noise as vivid as wind, vorticity of another sign.
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
from lidar_mi.plots import arrow_length, arrow_stretch, plot_flights, vorticity
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


@pytest.mark.slow
def test_matplotlib_is_loaded_by_the_first_plot():
    program = (
        "import sys, lidar_mi as lm; lm.retrieve_wind; lm.read_scan; import lidar_mi.plots; "
        "assert 'matplotlib' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def pair(width, height, spacing=1.0, circulation=400.0, radius=3.0):
    """Two Rankine vortices of opposite circulation, 40 m apart, in a plane of a size."""
    y = np.arange(-width / 2, width / 2 + spacing / 2, spacing)
    z = np.arange(-height / 2, height / 2 + spacing / 2, spacing)
    v, w = np.zeros((2, z.size, y.size))
    for side in (-1, 1):
        dy, dz = y[None] - 20 * side, z[:, None]
        rate = circulation / (2 * np.pi * np.maximum(dy**2 + dz**2, radius**2))
        v, w = v - side * rate * dz, w + side * rate * dy
    return xr.Dataset({"v": (("z", "y"), v), "w": (("z", "y"), w)}, {"z": z, "y": y})


@pytest.mark.parametrize("width", [60, 100, 140])
def test_arrows_are_seen_in_planes_of_any_size(width):
    """The median one has more than a hundredth of the width, the longest less than a quarter."""
    axes = pair(width, 0.6 * width, width / 140).lm.plot()
    shown = next(one for one in axes.collections if isinstance(one, Quiver))  # the valid ones
    length = np.ma.filled(np.ma.hypot(shown.U, shown.V), np.nan) / shown.scale / width
    assert np.nanmedian(length) > 0.01 and np.nanmax(length) < 0.25


def test_length_of_arrows():
    assert arrow_length(np.array([1.0, 1.0, np.nan]), 1.0) == 1.8
    assert arrow_length(np.array([1.0, 2.0, 9.0]), 9.0) == pytest.approx(1.8)
    assert arrow_length(np.array([1.0, 1.0, 12.0]), 12.0) == pytest.approx(4.0)
    assert arrow_length(np.array([]), 1.0) == arrow_length(np.zeros(3), 1.0) == 1.8


def test_vorticity_of_a_rankine_core():
    """2 times the rate of rotation, Gamma / (pi r^2), in the core and nothing outside."""
    wind = pair(140, 80, 0.5)
    found = wind.lm.vorticity()
    core = found.sel(y=20, z=0).item()
    # the other vortex is irrotational there
    assert core == pytest.approx(400 / (np.pi * 9), rel=1e-3)
    assert found.sel(y=-20, z=0).item() == pytest.approx(-core)
    assert abs(found.sel(y=0, z=30).item()) < 1e-3 * core
    flag = xr.zeros_like(wind["v"], dtype=int)
    flag.loc[{"y": 20.5, "z": 0.0}] = 4
    assert np.isnan(vorticity(wind.assign(flag=flag)).sel(y=20, z=0))


def test_vorticity_and_streamlines_are_drawn():
    axes = pair(100, 60, 2.0).lm.wind(colours="vorticity", lines="streamlines")
    mesh = axes.collections[0]
    low, high = mesh.get_clim()
    assert low == -high and mesh.get_array().min() < 0 < mesh.get_array().max()
    assert not arrows(axes) and axes.get_xlim() == (50, -50)
    with pytest.raises(lm.InputError, match="colours: 'red' is not allowed; expected speed or vor"):
        pair(100, 60, 2.0).lm.wind(colours="red")


def test_noise_is_not_as_vivid_as_wind(wind):
    """Pale where the standard error exceeds the speed; flagged vectors are short."""
    stderr = xr.full_like(wind["v"], 0.1)
    stderr.loc[{"y": 0.0, "z": 3.0}] = 100.0
    loud = wind.assign(v_stderr=stderr, w_stderr=stderr)
    loud["v"].loc[{"y": 0.0, "z": 1.0}] = 1e4  # the flagged one
    axes = loud.lm.plot()
    alpha = np.reshape(axes.collections[0].get_alpha(), (4, 5))
    # 0 m/s at y = 0, z = 0
    assert alpha[3, 2] == alpha[0, 2] == 0.25 and (alpha == 0.25).sum() == 2
    (((v, w),),) = ([*one.values()] for c, one in arrows(axes).items() if c == to_rgba("0.6"))
    # at most a distance between arrows: 1 m where the limit's arrow is 1.8 m long or more
    assert np.hypot(v, w) < np.hypot(33, 33) / 1.8
    assert {tuple(one) for one in (wind.lm.plot().get_xlim(), wind.lidar.plot().get_xlim())} == {
        (2.0, -2.0)
    }


def test_no_arrow_is_too_short_to_show_its_direction_but_those_without_one():
    """Where arrows are 1 m/s apart: 0.4 of it at least; 0.1 m/s with an error of 0.2 has none."""
    speeds = np.array([0.1, 0.1, 0.8, 3.0, 0.0])
    factors = arrow_stretch(speeds, np.array([0.05, 0.2, 0.1, 0.1, 0.0]), 1.0)
    np.testing.assert_allclose(factors * speeds, [0.4, 0.1, 0.8, 3.0, 0.0])
    np.testing.assert_allclose(arrow_stretch(speeds, None, 1.0) * speeds, [0.4, 0.4, 0.8, 3.0, 0.0])
