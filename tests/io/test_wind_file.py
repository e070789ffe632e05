"""A wind in every format that ``retrieve -o`` writes, read back by other programs.

Detects values, errors, flags or units that a format loses without saying so, an axis that is turned
or a format under the name of another.
"""

import csv

import numpy as np
import pytest
import xarray as xr
from scipy.io import loadmat

from lidar_mi.io.wind_file import SUFFIXES, write_wind

ROWS, COLUMNS = 4, 5


@pytest.fixture
def wind():
    """Every node with values of its own; one flagged, one missing."""
    rng = np.random.default_rng(1)
    z, y = 0.5 * np.arange(ROWS) - 1, 0.25 * np.arange(COLUMNS) + 3
    units = {"v": "m s-1", "w": "m s-1", "v_stderr": "m s-1", "displacement_y": "m"}
    units["displacement_z"] = "m"
    data = xr.Dataset(
        {
            name: (("z", "y"), rng.normal(size=(ROWS, COLUMNS)).astype("f4"), {"units": unit})
            for name, unit in units.items()
        },
        {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})},
        {"method": "cc", "software": "lidar-mi 0"},
    )
    data["v"][0, 1] = np.nan
    flag = np.zeros((ROWS, COLUMNS), "i2")
    flag[2, 3] = 5
    about = {"flag_masks": np.array([1, 2, 4], "i2"), "flag_meanings": "low out none"}
    return data.assign(flag=(("z", "y"), flag, about))


def test_netcdf_and_matlab_hold_all(tmp_path, wind):
    assert write_wind(tmp_path / "w.nc", wind, (0.5, 0.25)) == ""
    with xr.open_dataset(tmp_path / "w.nc") as read:
        xr.testing.assert_identical(read.load(), wind)
    write_wind(tmp_path / "w.mat", wind, (0.5, 0.25))
    read = loadmat(tmp_path / "w.mat")
    for name in ("v", "w", "v_stderr", "flag"):
        np.testing.assert_array_equal(read[name], wind[name].values)
    assert read["units"]["v_stderr"][0, 0][0] == "m s-1"


def test_csv_has_units_errors_and_flags(tmp_path, wind):
    write_wind(tmp_path / "w.csv", wind, (0.5, 0.25))
    with (tmp_path / "w.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == ROWS * COLUMNS
    for row in rows:
        one = wind.sel(y=float(row["y [m]"]), z=float(row["z [m]"]))
        for name in ("v", "w", "v_stderr"):
            # all digits of float32
            np.testing.assert_equal(np.float32(row[f"{name} [m s-1]"]), one[name].values)
        assert int(row["flag"]) == int(one["flag"])
        assert row["flag in words"] == ("low none" if int(one["flag"]) else "valid")


@pytest.mark.parametrize("suffix", [".vtk", ".vti"])
def test_vtk_is_read_by_vtk(tmp_path, wind, suffix):
    vtk = pytest.importorskip("vtk", reason="VTK's own reader is not installed")
    from vtk.util.numpy_support import vtk_to_numpy

    path = tmp_path / f"w{suffix}"
    write_wind(path, wind, (0.5, 0.25))
    legacy = suffix == ".vtk"
    reader = (vtk.vtkStructuredPointsReader if legacy else vtk.vtkXMLImageDataReader)()
    reader.SetFileName(str(path))
    if legacy:
        reader.ReadAllScalarsOn()
        reader.ReadAllVectorsOn()
    reader.Update()
    grid = reader.GetOutput()
    assert grid.GetDimensions() == (1, COLUMNS, ROWS)
    assert grid.GetOrigin() == (0.0, 3.0, -1.0) and grid.GetSpacing()[1:] == (0.25, 0.5)
    held = grid.GetPointData()
    # x runs fastest, then y: rows of z
    for name, label in (("v", "v [m s-1]"), ("v_stderr", "v_stderr [m s-1]"), ("flag", "flag")):
        found = vtk_to_numpy(held.GetArray(label)).reshape(ROWS, COLUMNS)
        np.testing.assert_array_equal(found, wind[name].values)
    vector = vtk_to_numpy(held.GetArray("wind [m s-1]")).reshape(ROWS, COLUMNS, 3)
    np.testing.assert_array_equal(vector[..., 2], wind["w"].values)
    assert not vector[..., 0].any()


def test_flow_is_in_pixels_to_the_right_and_down(tmp_path, wind):
    lost = write_wind(tmp_path / "w.flo", wind, (0.5, 0.25))
    assert "standard errors" in lost and "flags" in lost
    content = (tmp_path / "w.flo").read_bytes()
    assert content[:4] == b"PIEH"  # 202021.25 as a float
    assert np.frombuffer(content, "<f4", 1)[0] == np.float32(202021.25)
    assert np.frombuffer(content, "<i4", 2, 4).tolist() == [COLUMNS, ROWS]
    flow = np.frombuffer(content, "<f4", offset=12).reshape(ROWS, COLUMNS, 2)
    # the top row has the largest z, the left column the largest y
    for row, column in np.ndindex(ROWS, COLUMNS):
        one = wind.isel(z=ROWS - 1 - row, y=COLUMNS - 1 - column)
        if int(one["flag"]):
            assert (flow[row, column] > 1e9).all()
        else:
            moved = -float(one["displacement_y"]) / 0.25, -float(one["displacement_z"]) / 0.5
            np.testing.assert_allclose(flow[row, column], moved, rtol=1e-6)


def test_every_suffix_is_a_format_of_its_own(tmp_path, wind):
    starts = {
        ".nc": b"\x89HDF",
        ".csv": b"y [m],z [m]",
        ".mat": b"MATLAB 5.0",
        ".vtk": b"# vtk DataFile",
        ".vti": b"<",
        ".flo": b"PIEH",
    }
    assert set(starts) == set(SUFFIXES)
    for suffix, start in starts.items():
        write_wind(tmp_path / f"w{suffix}", wind, (0.5, 0.25))
        assert (tmp_path / f"w{suffix}").read_bytes().startswith(start)


def test_places_of_vectors_are_columns_only_where_they_differ(tmp_path, wind):
    z, y = xr.broadcast(wind["z"], wind["y"])
    for shift, there in ((0.0, False), (0.1, True)):
        placed = wind.assign_coords(y_vector=y + shift, z_vector=z)
        write_wind(tmp_path / "w.csv", placed, (0.5, 0.25))
        with (tmp_path / "w.csv").open() as file:
            heads = next(csv.reader(file))
        assert any(head.startswith("y_vector") for head in heads) == there
        assert not any(head.startswith("z_vector") for head in heads)
