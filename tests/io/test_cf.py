"""Wake files as CF describes them, by independent writers. Detects a feature that is read otherwise
than the conventions say: a missing value, a unit, a time, a sign, packing, a filter, a format."""

import bz2
import gzip
import lzma
import zipfile

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import sections
from lidar_mi.io import netcdf
from lidar_mi.io.netcdf import load_variable, open_netcdf
from lidar_mi.io.time_axis import count_unit, listing, state_at, tolerances
from lidar_mi.io.timed_table import read_timed_table
from lidar_mi.io.wake_file import read_wake
from tests.support import cf_files
from tests.support.cf_files import Stored, by_h5py, by_netcdf4, by_scipy, by_xarray, check

Y, Z = np.arange(-3.0, 4), np.arange(5.0)
SPEED = {"units": "m/s"}


def wake_file(values=None, **more):
    """v = y + 10 z, w = -v, on (z, y)."""
    v = Y + 10 * Z[:, None] if values is None else values
    return {
        "y": Stored(("y",), Y, {"units": "m"}),
        "z": Stored(("z",), Z, {"units": "m"}),
        "v": Stored(("z", "y"), v, SPEED | more),
        "w": Stored(("z", "y"), -(Y + 10 * Z[:, None]), SPEED),
    }


def timed(times, attributes, kind="f8"):
    """States 1, 2, 3 ... m/s."""
    file = wake_file()
    steps = np.arange(1.0, len(times) + 1)[:, None, None]
    for name in "vw":
        file[name] = Stored(("time", "z", "y"), steps * np.ones((len(times), 5, 7)), SPEED)
    file["time"] = Stored(("time",), np.array(times).astype(kind), attributes)
    return file


def refused(path, *words, **asked):
    with pytest.raises(InputError) as caught:
        read_wake(path, **asked)
    for word in (str(path), *words):
        assert word in str(caught.value), str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("first", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (20, 40))])
def test_any_features(first):
    assert not [said for seed in range(first, first + 20) if (said := check(seed))]


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 3000, 200))
def test_any_features_of_many_files(first):
    assert not [said for seed in range(first, first + 200) if (said := check(seed))]


@pytest.mark.parametrize("kind", ["i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_a_cell_that_nobody_wrote(tmp_path, kind):
    """netCDF4 masks the same one; types of one byte have no value to spare."""
    path = tmp_path / "killed.nc"
    values = np.full((5, 7), 3).astype(kind)
    file = wake_file(values)
    file["v"].unwritten = (2, 5)
    by_netcdf4(path, file)
    with netCDF4.Dataset(path) as data:
        assert np.argwhere(np.ma.getmaskarray(data["v"][:])).tolist() == [[2, 5]]
    refused(path, "'v' is not finite at 1 of 35 places, the first at x = 0 m, y = 2 m, z = 2 m")


@pytest.mark.parametrize("kind", ["i1", "u1"])
def test_all_values_of_one_byte_are_valid(tmp_path, kind):
    info = np.iinfo(kind)
    values = np.linspace(info.min, info.max, 35).astype(kind).reshape(5, 7)
    assert netCDF4.default_fillvals[kind] in (values.min(), values.max(), -127)
    by_netcdf4(tmp_path / "byte.nc", wake_file(values))
    np.testing.assert_array_equal(read_wake(tmp_path / "byte.nc").v[0].T, values)


@pytest.mark.parametrize("write", [by_scipy, by_h5py, by_xarray])
def test_an_unwritten_cell_beside_another_fill_value(tmp_path, write):
    """As tools leave it that set _FillValue afterwards."""
    values = np.ones((5, 7), "f4")
    values[1, 1] = 9.969209968386869e36
    write(tmp_path / "later.nc", wake_file(values, _FillValue=np.float32(-999)))
    refused(tmp_path / "later.nc", "not finite at 1 of 35")


@pytest.mark.parametrize(
    "limits, lost",
    [
        ({"valid_range": np.array([-100, 300], "i2")}, 2),  # packed: 0.1 m/s a step
        ({"valid_range": np.array([-10.0, 30.0], "f8")}, 2),  # of the unpacked
        ({"valid_max": np.int16(300)}, 1),
        ({"valid_min": np.int16(-100)}, 1),
        ({"valid_min": np.int16(-200), "valid_max": np.int16(400)}, 0),
    ],
)
@pytest.mark.parametrize("write", [by_scipy, by_netcdf4, by_h5py])
def test_limits_of_packed_values(tmp_path, write, limits, lost):
    """CF 8.1: in the type of the packed data; NUG: in that of the unpacked if it is wider."""
    values = np.full((5, 7), 250, "i2")
    values[0, 0], values[4, 6], values[2, 2] = -101, 301, 300
    write(tmp_path / "packed.nc", wake_file(values, scale_factor=np.float64(0.1), **limits))
    if lost:
        refused(tmp_path / "packed.nc", f"not finite at {lost} of 35", "valid ones are")
    else:
        found = read_wake(tmp_path / "packed.nc").v[0].T
        np.testing.assert_allclose(found, values * 0.1, rtol=1e-6)


def test_the_limit_itself_is_valid_in_every_type(tmp_path):
    values = np.full((5, 7), 0.1, "f4")
    by_h5py(tmp_path / "limit.nc", wake_file(values, valid_max=np.float64(0.1)))
    assert float(read_wake(tmp_path / "limit.nc").v.max()) == pytest.approx(0.1)


@pytest.mark.parametrize("limits", [{"valid_range": "0 to 5"}, {"valid_range": np.arange(3.0)}])
def test_limits_that_are_none(tmp_path, limits):
    by_h5py(tmp_path / "odd.nc", wake_file(**limits))
    refused(tmp_path / "odd.nc", "'v' has the valid_range", "expected two numbers")


EPOCH = {"units": "seconds since 1970-01-01", "calendar": "standard"}


@pytest.mark.parametrize("write", [by_scipy, by_netcdf4, by_h5py])
@pytest.mark.parametrize("first", [0.0, 1.6e9])
def test_times_are_as_exact_whatever_they_count_from(tmp_path, write, first):
    times = first + np.arange(0, 40, 10.0)
    write(tmp_path / "states.nc", timed(times, EPOCH))
    for index, time in enumerate(times):
        assert float(read_wake(tmp_path / "states.nc", time).v.mean()) == index + 1
        assert float(read_wake(tmp_path / "states.nc", time + 4e-4).time) == time
    listed = ", ".join(f"{t:.0f}" for t in times)
    for off in (13, 530, -1500, 0.02):
        refused(tmp_path / "states.nc", f"is not there; allowed: {listed} s", time=first + off)


def test_times_are_listed_as_the_shortest_numbers_that_mean_them(tmp_path):
    by_h5py(tmp_path / "half.nc", timed([1600000040, 1600000040.5], EPOCH))
    refused(tmp_path / "half.nc", "one of 1600000040, 1600000040.5 s")
    random = np.random.default_rng(5)
    for _ in range(200):
        kind = str(random.choice(["f4", "f8"]))
        start = random.choice([0, 40.0, 7200, 1.6e9 if kind == "f8" else 3e4])
        times = (start + random.choice([1e-3, 0.1, 0.25, 3]) * np.arange(5)).astype(kind)
        if np.unique(times).size < 5:
            continue
        rounding = np.spacing(times).astype(float) / 2
        times = times.astype(float)
        listed = listing(times, tolerances(times, rounding)).split(", ")
        for index, text in enumerate(listed):
            assert state_at(float(text), times, rounding, "file") == index


def test_states_that_single_precision_does_not_tell_apart(tmp_path):
    by_scipy(tmp_path / "single.nc", timed(1.6e9 + np.arange(0, 40, 10), EPOCH, "f4"))
    refused(tmp_path / "single.nc", "4 states have the time 1600000000 s", time=1.6e9)


def test_times_of_single_precision(tmp_path):
    times = 7200 + 0.1 * np.arange(4)
    by_h5py(tmp_path / "single.nc", timed(times, {"units": "s"}, "f4"))
    assert float(read_wake(tmp_path / "single.nc", 7200.1).v.mean()) == 2


@pytest.mark.parametrize(
    "units, factor",
    [
        ("hours since 1970-01-01", 3600),
        ("Days Since 1900-01-01T00:00:00Z", 86400),
        ("SECONDS since 2000-1-1 0:0:0", 1),
        ("msec since 2000-01-01 00:00 UTC", 1e-3),
        ("min", 60),
    ],
)
@pytest.mark.parametrize("calendar", ["noleap", "360_day", "julian"])
def test_units_and_calendars_of_times(tmp_path, units, factor, calendar):
    times = np.array([3600.0, 7200.0])
    by_netcdf4(tmp_path / "a.nc", timed(times / factor, {"units": units, "calendar": calendar}))
    assert float(read_wake(tmp_path / "a.nc", 7200.0).v.mean()) == 2


@pytest.mark.parametrize("units", ["months since 1970-01-01", "years", "common_year since 1-1-1"])
def test_times_without_a_fixed_length(tmp_path, units):
    by_h5py(tmp_path / "month.nc", timed([0, 1], {"units": units}))
    refused(tmp_path / "month.nc", f"time has the unit '{units}', of no fixed length", time=0.0)


def test_times_that_are_missing(tmp_path):
    by_h5py(tmp_path / "gap.nc", timed([0.0, 9.969209968386869e36, 2.0], {"units": "s"}))
    refused(
        tmp_path / "gap.nc", "'time' is not finite at 1 of 3 places, the first at index 1", time=0
    )


def test_a_table_counts_as_a_wake_does(tmp_path):
    rows = {
        "t": Stored(("t",), np.array([0.0, 1.0, 2.0]), {"units": "Minutes since 1970-01-01"}),
        "roll": Stored(("t",), np.array([0, 10, 20], "i2"), {"units": "deg"}),
    }
    by_netcdf4(tmp_path / "table.nc", rows)
    np.testing.assert_allclose(
        read_timed_table(tmp_path / "table.nc", {"roll": "rad"})["t"], [0, 60, 120]
    )
    rows["roll"].unwritten = (1,)
    by_netcdf4(tmp_path / "table.nc", rows)
    with pytest.raises(InputError, match="roll: nan in row 2 is not allowed"):
        read_timed_table(tmp_path / "table.nc", {"roll": "rad"})
    with pytest.raises(InputError, match="no fixed length"):
        count_unit("months since 2000-01-01", "table")


def test_depths_are_refused_where_the_sign_of_w_is_not_known(tmp_path):
    file = wake_file()
    file["z"] = Stored(("z",), Z, {"units": "m", "positive": "down"})
    by_h5py(tmp_path / "depth.nc", file)
    refused(tmp_path / "depth.nc", "'z' is positive down", "{z: -z, w: -w}")
    both = read_wake(tmp_path / "depth.nc", names={"z": "-z", "w": "-w"})
    assert both.w.sel(y=0, z=-3).item() == 30 and both.v.sel(y=0, z=-3).item() == 30
    file["w"].attributes = SPEED | {"standard_name": "upward_air_velocity"}
    by_h5py(tmp_path / "depth.nc", file)
    assert read_wake(tmp_path / "depth.nc").w.sel(y=0, z=-3).item() == -30


@pytest.mark.parametrize("units", ["degrees", "degrees_north", "hPa", "1", "level"])
def test_axes_that_are_no_lengths(tmp_path, units):
    file = wake_file()
    file["y"].attributes = {"units": units}
    by_netcdf4(tmp_path / "axis.nc", file)
    refused(tmp_path / "axis.nc", f"y has the unit '{units}'; allowed: m")


def test_axes_that_nobody_finished_writing(tmp_path):
    file = wake_file()
    file["y"].unwritten = (6,)
    by_netcdf4(tmp_path / "axis.nc", file)
    refused(tmp_path / "axis.nc", "axis 'y' is not finite at 1 of 7 places, the first at index 6")


def test_strings_and_compounds_beside_the_wind(tmp_path):
    with h5py.File(tmp_path / "more.nc", "w") as data:
        for name, one in wake_file().items():
            data[name] = one.values
            data[name].attrs.update(one.attributes)
        for dim, other in (("y", 1), ("z", 0)):
            data[dim].make_scale(dim)
            for name in "vw":
                data[name].dims[other].attach_scale(data[dim])
        data["run"] = "les of a wake"
        data["pairs"] = np.zeros(3, [("a", "f4"), ("b", "i4")])
    assert read_wake(tmp_path / "more.nc").v.shape == (1, 7, 5)


def test_a_plane_and_a_staggered_axis_far_from_the_origin(tmp_path):
    """Northings of 5800 km: rounding is that of the axis, not of its origin."""
    north = 5.8e6
    v = np.ones((3, 6, 5))
    data = xr.Dataset(
        {"v": (("x", "yv", "z"), v, SPEED), "w": (("x", "y", "z"), np.ones((3, 7, 5)), SPEED)},
        {
            "x": ("x", north + np.arange(3.0), {"units": "m"}),
            "y": ("y", north + np.arange(7.0), {"units": "m"}),
            "yv": ("yv", north + 0.5 + np.arange(6.0), {"units": "m"}),
            "z": ("z", Z, {"units": "m"}),
        },
    )
    data.to_netcdf(tmp_path / "utm.nc", engine="h5netcdf")
    wake = read_wake(tmp_path / "utm.nc", x=north + 1)
    # v has no value beyond its faces, from which a spline would extrapolate
    assert (wake.y.values - north).tolist() == [1, 2, 3, 4, 5]
    refused(tmp_path / "utm.nc", "x = 5800003 m is outside", "5800002.5 m", x=north + 3)


@pytest.mark.parametrize("name", ["zlib", "zstd", "bzip2", "szip"])
def test_filters_of_the_library(tmp_path, name):
    values = np.random.default_rng(1).random((50, 70)).astype("f4")
    file = wake_file(values)
    file["y"].values, file["z"].values = np.arange(70.0), np.arange(50.0)
    file["w"].values = values
    by_netcdf4(tmp_path / "a.nc", file, compression=name)
    np.testing.assert_array_equal(read_wake(tmp_path / "a.nc").v[0].T, values)


def test_cdf5_by_the_library(tmp_path):
    by_netcdf4(tmp_path / "big.nc", wake_file(), form="NETCDF3_64BIT_DATA")
    np.testing.assert_array_equal(read_wake(tmp_path / "big.nc").v[0].T, Y + 10 * Z[:, None])


@pytest.mark.parametrize(
    "how, words",
    [
        ({"compression": "zstd"}, ("is compressed with zstd", "zlib: nccopy -d 4")),
        ({"compression": "bzip2"}, ("is compressed with bzip2", "zlib: nccopy -d 4")),
        ({"form": "NETCDF3_64BIT_DATA"}, ("64-bit data (CDF-5)", "nccopy -k nc4")),
    ],
)
def test_sound_files_without_the_library_that_reads_them(tmp_path, monkeypatch, how, words):
    monkeypatch.setattr(netcdf, "find_spec", lambda name: None)
    # where netCDF4 was imported, its filters are there for h5py, too
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: code < 300)
    by_netcdf4(tmp_path / "a.nc", wake_file(), **how)
    said = refused(tmp_path / "a.nc", *words, "or pip install netCDF4")
    assert "damaged" not in said


def test_files_of_other_kinds_say_what_to_type(tmp_path):
    whole = tmp_path / "wake.nc"
    by_netcdf4(whole, wake_file())
    content = whole.read_bytes()
    with zipfile.ZipFile(tmp_path / "wake.zip", "w") as pack:
        pack.writestr("wake.nc", content)
    others = {
        "a b.nc.gz": (gzip.compress(content), "gunzip '"),
        "wake.nc.bz2": (bz2.compress(content), "bunzip2 "),
        "wake.nc.xz": (lzma.compress(content), "unxz "),
        "wake.zip": ((tmp_path / "wake.zip").read_bytes(), "unzip "),
        "wake.cdl": (b"netcdf wake {\n}", "ncgen -4 -o out.nc "),
        "wake.hdf": (b"\x0e\x03\x13\x01" + bytes(100), "HDF4"),
        "wake.grib": (b"GRIB" + bytes(100), "cdo -f nc4 copy "),
    }
    for name, (data, word) in others.items():
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name, word)
    store = tmp_path / "wake.zarr"
    store.mkdir()
    (store / "zarr.json").write_text("{}")
    refused(store, "is a Zarr store", "open_zarr")
    with h5py.File(tmp_path / "groups.nc", "w") as data:
        data["run1/v"] = np.ones((5, 7))
    refused(tmp_path / "groups.nc", "has all variables in groups (run1)", "ncks -G : -g run1")


def test_hdf5_behind_a_block_of_the_users(tmp_path):
    with h5py.File(tmp_path / "block.nc", "w", userblock_size=512) as data:
        data["v"] = np.ones(3)
    with open_netcdf(tmp_path / "block.nc") as data:
        assert load_variable(data["v"], tmp_path / "block.nc").sum() == 3


def test_names_that_xarray_takes_for_more(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("~", "a:", "$HOME.nc", "-o"):
        by_h5py(tmp_path / name, wake_file())
        assert read_wake(name).v.shape == (1, 7, 5)


def test_the_check_itself_finds_faults(monkeypatch):
    """Each of these readers is wrong in one respect."""
    nearest = {"state_at": lambda time, times, *_: int(np.argmin(np.abs(times - time)))}
    endless = {"valid_range": lambda *_: (-np.inf, np.inf)}
    for module, changed in ((cf_files.read_wake.__globals__, nearest), (netcdf.__dict__, endless)):
        with monkeypatch.context() as patch:
            for name, other in changed.items():
                patch.setitem(module, name, other)
            assert any(check(seed) for seed in range(30))


def test_info_tells_the_ends_of_a_time_axis_apart(tmp_path):
    by_netcdf4(tmp_path / "epoch.nc", timed(1.6e9 + np.arange(3), EPOCH))
    rows = {row[0]: row for row in next(sections(str(tmp_path / "epoch.nc")))[1]}
    assert rows["time"][2] == "1600000000 ... 1600000002" and rows["v"][2] == "1 ... 3"
    (tmp_path / "epoch.nc.gz").write_bytes(gzip.compress((tmp_path / "epoch.nc").read_bytes()))
    with pytest.raises(InputError, match=r"is compressed with gzip; .* gunzip "):
        list(sections(str(tmp_path / "epoch.nc.gz")))


def test_an_experiment_names_what_it_cannot_read(tmp_path):
    """A folder in the place of a file, a second state 3 s beside the one that is there."""
    store = tmp_path / "wake.zarr"
    store.mkdir()
    (store / ".zgroup").write_text("{}")
    changes = {"wake.file": str(store), "wake.time": None, "wake.extinction.tracer": None}
    with pytest.raises(InputError, match="is a Zarr store; expected a NetCDF file"):
        lm.make_truth(lm.load_experiment("wake_backscatter", **changes))
    by_h5py(tmp_path / "epoch.nc", timed(1.6e9 + np.arange(0, 40, 10), EPOCH))
    changes |= {"wake.file": str(tmp_path / "epoch.nc"), "wake.extinction.source": "speed"}
    changes |= {"wake.time": "1600000000 s", "wake.second": "1600000013 s", "platform.dt": "13 s"}
    changes |= {"platform.speed": "10 m/s"}
    with pytest.raises(InputError, match="time 1600000013 s is not there; allowed: 1600000000, "):
        lm.make_truth(lm.load_experiment("wake_backscatter", **changes))
