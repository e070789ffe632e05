"""Recipes for flow solvers, run as printed on small files in the layouts of these programs.

Detects a recipe that does not run, mixes axes or components, or reads another plane or height.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

from lidar_mi.io.wake_file import read_wake

PAGE = (Path(__file__).parents[2] / "docs" / "cfd.md").read_text()


def printed(name):
    """The block of the page that begins with a comment of this name."""
    return re.search(rf"```\w+\n(# {re.escape(name)}\n.*?)```", PAGE, re.DOTALL)[1]


def v(x, y, z):
    return 2 * np.sin(y / 5) + 0.1 * z + 0.01 * x


def w(x, y, z):
    return 3 * np.cos(z / 7) - 0.2 * y + 0.02 * x


def tracer(x, y, z):
    return 1 + 0.01 * y + 0.02 * z + 0.001 * x


def on(field, *axes):
    """A field on axes (z, y, x) of a solver's file."""
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return field(x, y, z)


def compare(wake, x, tolerance):
    at = wake.y.values[:, None], wake.z.values
    for name, field in (("v", v), ("w", w), ("tracer", tracer)):
        np.testing.assert_allclose(
            wake[name].values[0], field(x, *at), atol=tolerance, err_msg=name
        )


@pytest.mark.slow
def test_palm(tmp_path):
    x, y, zu = np.arange(1.0, 128, 2), np.arange(1.0, 60, 2), np.arange(-1.0, 60, 2)
    yv, zw = y - 1, zu + 1
    fields = {
        "v": (("time", "zu_3d", "yv", "x"), on(v, zu, yv, x)[None], {"units": "m/s"}),
        "w": (("time", "zw_3d", "y", "x"), on(w, zw, y, x)[None], {"units": "m/s"}),
        "s": (("time", "zu_3d", "y", "x"), on(tracer, zu, y, x)[None], {"units": "kg/m3"}),
    }
    axes = {"x": x, "y": y, "yv": yv, "zu_3d": zu, "zw_3d": zw}
    coordinates = {name: (name, values, {"units": "m"}) for name, values in axes.items()}
    coordinates["time"] = "time", [600.0], {"units": "seconds since 2019-06-21 12:00:00 +00"}
    for _, values, _ in fields.values():
        values[:, 0] = np.nan  # the ground, which PALM masks by a fill value
    xr.Dataset(fields, coordinates).to_netcdf(tmp_path / "palm_3d.nc", engine="h5netcdf")
    said = yaml.safe_load(printed("palm.yaml"))["wake"]
    names = said["names"]
    wake = read_wake(tmp_path / said["file"], 600.0, names, 63.0, require=["tracer"])
    compare(wake, 63.0, 0.02)
    assert "v to" in wake.attrs["interpolated"] and "w to" in wake.attrs["interpolated"]
    assert "tracer" not in wake.attrs["interpolated"]


@pytest.mark.usefixtures("in_folder")
def test_wrf():
    faces = np.cumsum(np.r_[0.0, np.linspace(1, 3, 20)])  # levels are farther apart above
    z, y, x = (faces[1:] + faces[:-1]) / 2, 2 * np.arange(30) + 1.0, np.array([1.0])
    geopotential = on(lambda x, y, z: 9.81 * z, faces, y, x)
    levels = ("Time", "bottom_top_stag", "south_north", "west_east")
    fields = {
        "PH": (levels, 0.25 * geopotential[None]),
        "PHB": (levels, 0.75 * geopotential[None]),
        "V": (
            ("Time", "bottom_top", "south_north_stag", "west_east"),
            on(v, z, 2.0 * np.arange(31), x)[None],
        ),
        "W": (levels, on(w, faces, y, x)[None]),
        "tr17_1": (("Time", "bottom_top", "south_north", "west_east"), on(tracer, z, y, x)[None]),
    }
    xr.Dataset(fields, attrs={"DX": 2.0, "DY": 2.0}).to_netcdf("wrfout.nc", engine="h5netcdf")
    exec(printed("wrf.py"), {})
    compare(read_wake("wake.nc", require=["tracer"]), 1.0, 0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("in_folder")
def test_openfoam():
    """Points of cells without order."""
    rng = np.random.default_rng(2)
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-15, 16, 0.7), np.arange(0, 21, 0.7)))
    places = np.stack([0 * y + 4, y, z], 1)
    places[:, 1:] += rng.uniform(-0.1, 0.1, (y.size, 2))
    rng.shuffle(places)
    flow = np.stack([0 * y, v(*places.T), w(*places.T)], 1)
    head = "# U  FACE_DATA\n#  x  y  z  U_x  U_y  U_z"
    np.savetxt("U_plane.raw", np.c_[places, flow], header=head)
    np.savetxt("tracer_plane.raw", np.c_[places, tracer(*places.T)], header="x y z tracer")
    exec(printed("openfoam.py"), {})
    wake = read_wake("wake.nc", require=["tracer"])
    compare(wake, 4.0, 0.02)
    assert "interpolated" not in wake.attrs and float(wake.y[1] - wake.y[0]) == 0.5


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
