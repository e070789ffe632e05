"""NetCDF files: unit tests. Detect a value or a fill value changed on the way, a file half written,
and any damaged file that does not give one clear line."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.netcdf import load_variable, open_netcdf, read_netcdf, write_netcdf

DATA = xr.Dataset({"v": ("y", [1.0, np.nan, 3.0])}, {"y": ("y", [0.0, 0.5, 1.0], {"units": "m"})})


def test_round_trip(tmp_path):
    write_netcdf(DATA, tmp_path / "wind.nc")
    xr.testing.assert_identical(read_netcdf(tmp_path / "wind.nc"), DATA)
    with xr.open_dataset(tmp_path / "wind.nc", engine="h5netcdf") as stored:
        assert "_FillValue" not in stored["y"].encoding  # CF 2.5.1


def test_netcdf_3_and_4_are_distinguished_by_their_content(tmp_path):
    for engine, name in (("scipy", "old.nc"), ("h5netcdf", "new.cdf")):
        DATA.to_netcdf(tmp_path / name, engine=engine)
        with open_netcdf(tmp_path / name) as data:
            np.testing.assert_array_equal(data["v"], DATA["v"])


def test_no_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere is no folder; expected one that exists"):
        write_netcdf(DATA, tmp_path / "nowhere" / "wind.nc")


@pytest.mark.parametrize("cut", [3, 40, 900, -30])
def test_damaged_files_give_one_line(tmp_path, cut):
    path = tmp_path / "wind.nc"
    write_netcdf(DATA, path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError) as error:
        read_netcdf(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("shape", "chunks"), [((30_000, 30_000), (10, 10)), ((10, 10), None), ((9_000, 9_000), None)]
)
def test_declared_size_is_bounded_by_the_file_size(tmp_path, shape, chunks):
    """Values that were never written take no room in the file."""
    path = tmp_path / "sparse.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("v", shape, "f8", chunks=chunks)
    with open_netcdf(path) as data:
        if shape == (10, 10):
            assert load_variable(data["v"], path).shape == shape
            return
        for read in (lambda: load_variable(data["v"], path), lambda: read_netcdf(path)):
            with pytest.raises(InputError, match=r"declares .* expected at most 256 MiB"):
                read()


def test_an_axis_and_a_chunk_are_bounded_before_the_file_is_open(tmp_path):
    with h5py.File(tmp_path / "axis.nc", "w") as file:
        file.create_dataset("y", (10**10,), "f8", chunks=(1000,)).make_scale("y")
    with h5py.File(tmp_path / "chunk.nc", "w") as file:
        file.create_dataset("v", (10, 10**9), "f8", chunks=(1, 5 * 10**7))
    for name, what in (("axis.nc", "y declares 8e"), ("chunk.nc", "v declares 4e")):
        with pytest.raises(InputError, match=what):
            open_netcdf(tmp_path / name)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no.nc: cannot be read .No such file"):
        open_netcdf(tmp_path / "no.nc")


def test_a_full_disk_leaves_the_old_file_and_the_process_alive(tmp_path):
    """In a process of its own, which HDF5 would take down: no file may grow beyond 100 kB."""
    path = tmp_path / "wind.nc"
    write_netcdf(DATA, path)
    code = f"""
import resource, numpy as np, xarray as xr
from lidar_mi.errors import InputError
from lidar_mi.io.netcdf import write_netcdf
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
data = xr.Dataset({{"v": ("y", np.random.default_rng(1).random(100_000))}})
try:
    write_netcdf(data, {str(path)!r})
except InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{path}: cannot be written (File too large)")
    assert [p.name for p in tmp_path.iterdir()] == ["wind.nc"]
    xr.testing.assert_identical(read_netcdf(path), DATA)
