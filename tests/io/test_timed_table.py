"""Tables in time from CSV and NetCDF: units, both formats alike, one clear line for bad input."""

import re

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.timed_table import read_timed_table

UNITS = {"y": "m", "roll": "rad"}


def test_units_are_converted_and_other_columns_ignored(tmp_path):
    path = tmp_path / "flight.csv"
    path.write_text("# a flight\nt (ms), roll [deg], y, remark\n0, 90, 1.5, 7\n\n10,-180,2,8\n")
    found = read_timed_table(path, UNITS)
    assert set(found) == {"t", "y", "roll"}
    assert found["t"] == pytest.approx([0, 0.01])
    assert found["roll"] == pytest.approx([np.pi / 2, -np.pi])
    assert found["y"].tolist() == [1.5, 2.0]


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_netcdf_is_read_as_csv_is(tmp_path, engine):
    path = tmp_path / "flight.nc"
    data = xr.Dataset(
        {
            "roll": ("t", [90.0, -180.0], {"units": "degree"}),
            "y": ("t", [150, 200], {"units": "cm"}),
        },
        coords={"t": ("t", [0.0, 0.01], {"units": "seconds since 2026-01-01"})},
    )
    data.to_netcdf(path, engine=engine)
    found = read_timed_table(path, UNITS)
    assert found["roll"] == pytest.approx([np.pi / 2, -np.pi])
    assert found["y"] == pytest.approx([1.5, 2.0]) and found["t"] == pytest.approx([0, 0.01])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,y\n0,1\n0.2,nan\n", "y: nan in row 2 is not allowed; expected finite numbers"),
        ("t,y\n0,1\n0.2,1\n0.1,2\n", "t: 0.1 s in row 3 after 0.2 s is not allowed; expected"),
        ("t,y\n0,1\n0,2\n", "t: 0 s in row 2 after 0 s is not allowed"),
        ("t,y\n0,1\n", "1 rows; expected two or more"),
        ("t,y\n0,1\n1\n", "1 values in row 2; expected 2, as in its head"),
        ("t,y\n0,1\n1,a b\n", "y: 'a b' in row 2 is not allowed; expected a number"),
        ("t,roll\n0,1\n1,2\n", "roll: without a unit; expected deg or rad"),
        ("t,roll (m)\n0,1\n1,2\n", "roll: unit 'm' is not allowed; expected deg or rad"),
        ("t,y (s)\n0,1\n1,2\n", "y: unit 's' is not allowed; expected m or a unit that conv"),
        ("t,t\n0,1\n1,2\n", "column t twice; expected each once"),
        ("y\n0\n1\n", "t missing; expected columns t, y, roll, not 'y'"),
        (
            "t,pitch (deg)\n0,1\n1,2\n",
            "all of y, roll missing; expected columns t, y, roll, not 't', 'pitch (deg)'",
        ),
        ("t;y\n0;1\n1;2\n", "t missing; expected columns t, y, roll, not 't;y'"),
        ("# nothing\n", "empty; expected a head and numbers: t, y, roll"),
        ('t,y\n"0,1\n', "not a CSV table"),
    ],
)
def test_a_bad_table_is_one_line(tmp_path, text, message):
    path = tmp_path / "flight.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=f"^{re.escape(f'{path}: {message}')}") as error:
        read_timed_table(path, UNITS)
    assert "\n" not in str(error.value)


def test_bad_netcdf_is_one_line(tmp_path):
    path = tmp_path / "flight.nc"
    xr.Dataset({"t": ("a", [0.0, 1.0]), "y": ("b", [0.0, 1.0, 2.0])}).to_netcdf(
        path, engine="h5netcdf"
    )
    with pytest.raises(InputError, match=r"t, y have \[2, 3\] values; expected equally many"):
        read_timed_table(path, UNITS)
    xr.Dataset({"t": ("a", [0.0, 1.0]), "y": (("a", "b"), np.zeros((2, 2)))}).to_netcdf(
        path, engine="h5netcdf"
    )
    with pytest.raises(InputError, match="y: float64 of 2 dimensions is not allowed"):
        read_timed_table(path, UNITS)
