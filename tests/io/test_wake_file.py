"""The reader against files written by hand: detects any lost sign, axis or unit, and any bad
file that does not end in one line naming file, variable and what is allowed."""

import gc
from importlib.resources import files

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.wake import resample
from lidar_mi.errors import InputError
from lidar_mi.io.wake_file import read_wake
from lidar_mi.units import parse_units

SLAB = files("lidar_mi.scenes") / "wake_slab_40s.nc"
T, X, Y, Z = (np.array([1.0, 1.1]), np.arange(3) + 0.5, np.arange(6) - 2.5, np.arange(5) * 2.0)


def field(t, x, y, z):
    """Differs along every axis."""
    return 1000 * t + 100 * x + 10 * y + z


def example() -> xr.Dataset:
    values = field(*np.meshgrid(T, X, Y, Z, indexing="ij"))
    dims = ("time", "x", "y", "z")
    return xr.Dataset(
        {
            "v": (dims, values, {"units": "m s-1"}),
            "w": (dims, -values, {"units": "m s-1"}),
            "tracer": (dims, values / 2e4 + 0.1, {"units": "1"}),
        },
        coords={
            "time": ("time", T, {"units": "s"}),
            "x": ("x", X, {"units": "m"}),
            "y": ("y", Y, {"units": "m"}),
            "z": ("z", Z, {"units": "m"}),
        },
    )


@pytest.fixture
def write(tmp_path):
    def write(data, engine="h5netcdf", name="les.nc"):
        path = tmp_path / name
        data.to_netcdf(path, engine=engine)
        return path

    return write


def fails(path, *words, **arguments):
    """One line, with the file and all the words in it."""
    with pytest.raises(InputError) as caught:
        read_wake(path, **arguments)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(path), *words):
        assert word in message, message


def expected(t, x=X, y=Y, z=Z):
    return field(t, *np.meshgrid(x, y, z, indexing="ij"))


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_values_land_where_they_belong(write, engine):
    wake = read_wake(write(example(), engine), time=1.1)
    assert wake.v.dims == ("x", "y", "z") and wake.v.dtype == np.float64
    np.testing.assert_allclose(wake.v, expected(1.1), rtol=1e-12)
    np.testing.assert_allclose(wake.w, -expected(1.1), rtol=1e-12)
    assert set(wake.data_vars) == {"v", "w", "tracer"}
    assert float(wake.time) == pytest.approx(1.1)
    assert wake.v.attrs["units"] == "m s-1"


def test_any_order_of_dimensions_and_descending_axes(write):
    data = example().transpose("z", "time", "y", "x").isel(y=slice(None, None, -1))
    data = data.isel(z=slice(None, None, -1))
    wake = read_wake(write(data), time=1.0)
    np.testing.assert_allclose(wake.y, Y)
    np.testing.assert_allclose(wake.z, Z)
    np.testing.assert_allclose(wake.v, expected(1.0), rtol=1e-12)


def test_names_are_mapped(write):
    data = example().rename(v="V_wind", y="lateral", time="age")
    wake = read_wake(write(data), time=1.0, names={"v": "V_wind", "y": "lateral", "time": "age"})
    np.testing.assert_allclose(wake.v, expected(1.0), rtol=1e-12)


def test_units_are_converted(write):
    data = example()
    data["v"] = data.v * 3.6
    data.v.attrs["units"] = "km/h"
    data["y"] = ("y", Y / 1000, {"units": "km"})
    data["time"] = ("time", T / 60, {"units": "minutes since 2000-01-01"})
    wake = read_wake(write(data), time=1.1)
    np.testing.assert_allclose(wake.v, expected(1.1), rtol=1e-12)
    np.testing.assert_allclose(wake.y, Y, atol=1e-12)


def test_packed_integers_are_unpacked(tmp_path):
    data = example()
    path = tmp_path / "packed.nc"
    packing = {"dtype": "int32", "scale_factor": 1e-3, "_FillValue": -(2**31)}
    data.to_netcdf(path, engine="h5netcdf", encoding={"v": packing})
    np.testing.assert_allclose(read_wake(path, time=1.0).v, expected(1.0), atol=1e-3)


def test_one_plane_by_value(write):
    path = write(example())
    wake = read_wake(path, time=1.0, x=1.6)
    assert wake.x.values.tolist() == [1.5]
    np.testing.assert_allclose(wake.v, expected(1.0, x=[1.5]), rtol=1e-12)
    assert read_wake(path, time=1.0, x=3.0).x.values.tolist() == [2.5]  # the last cell's face
    fails(path, "x = 3.1 m", "0 to 3 m", time=1.0, x=3.1)


def test_slab_without_x_or_time(write):
    data = example().isel(time=0, x=1, drop=True)
    wake = read_wake(write(data))
    assert wake.v.shape == (1, 6, 5) and wake.x.values.tolist() == [0.0]
    assert "time" not in wake.coords
    np.testing.assert_allclose(wake.v[0], expected(1.0, x=[1.5])[0], rtol=1e-12)
    fails(write(data), "no 'x'", x=0.5)
    fails(write(data), "no 'time'", time=1.0)
    kept = example().isel(time=0, x=1)  # as scalar coordinates
    wake = read_wake(write(kept), time=1.0)
    assert wake.x.values.tolist() == [1.5] and float(wake.time) == 1.0


def test_time_is_picked_by_value(write):
    path = write(example())
    assert float(read_wake(path, time=1.1 * (1 + 5e-7)).time) == pytest.approx(1.1)
    fails(path, "1.05", "1, 1.1 s", time=1.05)
    fails(path, "has 2 times, and none is chosen", "wake.time: one of 1, 1.1 s")
    assert float(read_wake(write(example().isel(time=[1]))).time) == pytest.approx(1.1)


@pytest.mark.filterwarnings("ignore:Cannot close a netcdf_file:RuntimeWarning")
def test_files_that_are_not_netcdf(tmp_path, write):
    fails(tmp_path / "absent.nc", "cannot be read", "No such file")
    fails(tmp_path, "cannot be read")
    text = tmp_path / "text.nc"
    text.write_text("v w\n1 2\n")
    fails(text, "not NetCDF")
    empty = tmp_path / "empty.nc"
    empty.touch()
    fails(empty, "not NetCDF")
    for engine in ("h5netcdf", "scipy"):
        whole = write(example(), engine, "whole.nc").read_bytes()
        cut = tmp_path / f"cut_{engine}.nc"
        cut.write_bytes(whole[: len(whole) // 2])
        fails(cut, "damaged", time=1.0)
    gc.collect()  # scipy warns when the half-open file goes, and should do it here


def test_missing_variables_and_dimensions(write):
    fails(write(example().drop_vars("w")), "'w'", "missing", "v, tracer", time=1.0)
    fails(write(example()), "'aerosol'", "missing", time=1.0, require=["aerosol"])
    fails(write(example()), "'smoke'", "missing", time=1.0, names={"tracer": "smoke"})
    fails(write(example().rename(y="lateral")), "'y'", "missing", "lateral", time=1.0)
    fails(write(example().drop_vars("y")), "'y'", "no values", time=1.0)
    data = example()
    data["w"] = data.w.isel(x=0, drop=True)
    fails(write(data), "'w'", "(time, y, z)", "x, y, z", time=1.0)


def test_bad_names():
    for names, word in (({"V": "v"}, "'V'"), ({"v": "w"}, "more than one"), ({"v": 3}, "3")):
        with pytest.raises(InputError, match=word):
            read_wake(SLAB, names=names)
    with pytest.raises(InputError, match="'smoke'"):
        read_wake(SLAB, require=["smoke"])


def test_values_that_are_not_finite(write):
    data = example()
    data.v[1, 2, 3, 4] = np.nan
    data.v[1, 2, 4, 0] = np.inf
    fails(
        write(data),
        "'v'",
        "not finite at 2 of 90 places",
        "x = 2.5 m, y = 0.5 m, z = 8 m",
        time=1.1,
    )
    np.testing.assert_allclose(read_wake(write(data), time=1.0).v, expected(1.0), rtol=1e-12)
    data = example()
    data["y"] = ("y", np.where(Y == 0.5, np.nan, Y), {"units": "m"})
    fails(write(data), "'y'", "index 3", time=1.0)


def test_a_negative_tracer_is_named_where_it_is_used(write):
    data = example()
    data = data.rename(tracer="smoke")
    data.smoke[0, 2, 3, 4] = -0.25
    names = {"tracer": "smoke"}
    place = "x = 2.5 m, y = 0.5 m, z = 8 m"
    fails(write(data), "'smoke' is negative at 1 of 90 places", place, time=1.0, names=names)
    # not used, hence no fault; velocities may be what they like
    assert "tracer" not in read_wake(write(data), time=1.0)
    assert (read_wake(write(example()), time=1.0).w < 0).any()


def test_axes_that_turn_back(write):
    data = example()
    folded = Y.copy()
    folded[3] = folded[2]
    data["y"] = ("y", folded, {"units": "m"})
    fails(write(data), "'y'", "turns back", "only rise", time=1.0)


def test_an_axis_in_single_precision_is_even(write):
    data = example()
    data["y"] = ("y", (Y + 5000).astype("float32"), {"units": "m"})
    wake = read_wake(write(data), time=1.0)
    np.testing.assert_array_equal(wake.y, Y + 5000)
    assert "interpolated" not in wake.attrs


def smooth(y, z):
    return 3 * np.sin(y / 6) * np.cos(z / 9)


def test_a_stretched_axis_is_interpolated_with_its_error(write):
    """Against the function that the nodes have; the stated error holds and is not ten times it."""
    y = 15 * np.sinh(np.linspace(-1.2, 1.2, 41))
    z = np.arange(21.0)
    value = smooth(y[:, None], z)
    data = xr.Dataset(
        {name: (("y", "z"), value, {"units": "m s-1"}) for name in ("v", "w")},
        {"y": ("y", y, {"units": "m"}), "z": ("z", z, {"units": "m"})},
    )
    wake = read_wake(write(data))
    steps = np.diff(wake.y)
    assert np.allclose(steps, steps[0]) and steps[0] <= np.diff(y).min() < 3 * steps[0]
    assert y[0] <= wake.y[0] < y[0] + 1 and y[-1] - 1 < wake.y[-1] <= y[-1]
    error = wake.v.values[0] - smooth(wake.y.values[:, None], wake.z.values)
    stated = float(wake.attrs["interpolated"].split("v to ")[1].split()[0])
    assert np.sqrt((error**2).mean()) < stated < 0.03
    # what is even is left as it is
    assert "interpolated" not in read_wake(write(data.isel(y=[0, 1]), name="even.nc")).attrs


def test_staggered_components_come_to_one_grid(write):
    """Each component on the faces of cells, as on an Arakawa C grid; linear fields are exact."""
    y, z = np.arange(0.5, 12), np.arange(0.5, 9)
    faces = {"yv": np.arange(1.0, 12), "zw": np.arange(0.0, 9)}
    axes = {"y": y, "z": z, **faces}
    data = xr.Dataset(
        {
            "v": (("yv", "z"), 2 * faces["yv"][:, None] + z, {"units": "m s-1"}),
            "w": (("zw", "y"), 3 * y - faces["zw"][:, None], {"units": "m s-1"}),
            "tracer": (("z", "y"), 1 + 0 * z[:, None] * y, {"units": "1"}),
        },
        {name: (name, values, {"units": "m"}) for name, values in axes.items()},
    )
    wake = read_wake(write(data))
    # faces of v begin at 1 m, those of w end at 8 m
    assert (wake.y[0], wake.y[-1], wake.z[0], wake.z[-1]) == (1.5, 10.5, 0.5, 7.5)
    at = wake.y.values[:, None], wake.z.values
    np.testing.assert_allclose(wake.v[0], 2 * at[0] + at[1], atol=1e-9)
    np.testing.assert_allclose(wake.w[0], 3 * at[0] - at[1], atol=1e-9)
    data["w"] = ("zw", "yv"), np.zeros((9, 11)), {"units": "m s-1"}
    fails(write(data, name="two.nc"), "'w'", "one of them staggered")


def test_wrong_units(write):
    for name, units in (("v", "K"), ("v", "banana"), ("y", "s"), ("time", "m")):
        data = example()
        data[name].attrs["units"] = units
        fails(write(data), f"{name}", f"'{units}'", "allowed:", time=1.0)
    data = example()
    del data.v.attrs["units"]
    fails(write(data), "'v'", "no units", "m s-1", time=1.0)
    data = example()
    del data.tracer.attrs["units"]  # CF: dimensionless
    assert "tracer" in read_wake(write(data), time=1.0)


def test_tracer_of_any_unit(write):
    """Soot in kg m-3, as a solver writes it: taken as it is, for only its shape counts."""
    data = example()
    data["tracer"].values[:] *= 1e-9
    data.tracer.attrs["units"] = "kg m-3"
    wake, plain = read_wake(write(data), time=1.0), read_wake(write(example()), time=1.0)
    assert wake.tracer.attrs["units"] == "kg m-3"
    np.testing.assert_allclose(wake.tracer, plain.tracer * 1e-9, rtol=1e-12)


def test_names_that_nobody_has_mapped(write):
    """Whoever leaves wake.names out learns of it; whoever has used it needs no advice."""
    data = example().rename(tracer="soot")
    fails(
        write(data),
        "'tracer'",
        "soot; expected wake.names: {tracer: its name there}, or",
        "wake.extinction.tracer: null",
        time=1.0,
        require=["tracer"],
    )
    fails(write(example().rename(y="span")), "'y'", "expected wake.names: {y: ", time=1.0)
    with pytest.raises(InputError, match=r"it has [a-z, ]+$"):
        read_wake(write(data), time=1.0, names={"tracer": "smoke"})


def test_nodes_without_number(write):
    wake = read_wake(write(example()), time=1.0)
    with pytest.raises(InputError, match=r"wake.spacing: 1e-05 m is not allowed, it makes .* nod"):
        resample(wake, 1e-5)


def test_text_is_not_a_velocity(write):
    data = example().isel(time=[0], x=[0])
    data["v"] = (data.v.dims, np.full(data.v.shape, "fast"), {"units": "m s-1"})
    fails(write(data), "'v'", "allowed: numbers")


@pytest.mark.parametrize(
    "text, si",
    [
        ("m s-1", 1.0),
        ("m.s-1", 1.0),
        ("m s^-1", 1.0),
        ("m/s", 1.0),
        ("km/h", 1 / 3.6),
        ("cm s-1", 0.01),
        ("knot", 1852 / 3600),
    ],
)
def test_speeds_in_cf_writing(text, si):
    assert parse_units(text).to("m/s").magnitude == pytest.approx(si, rel=1e-12)


@pytest.mark.parametrize("text, si", [("1", 1), ("", 1), ("%", 0.01), ("1e-3", 1e-3)])
def test_pure_numbers_in_cf_writing(text, si):
    assert parse_units(text).to("").magnitude == pytest.approx(si, rel=1e-12)


def test_powers_in_cf_writing():
    assert parse_units("kg m-3").to("g/cm**3").magnitude == pytest.approx(1e-3)
    assert parse_units("m2 s-2").to("km**2/s**2").magnitude == pytest.approx(1e-6)
    for text in ("banana", "m s-", "-"):
        with pytest.raises(ValueError, match="is not a unit"):
            parse_units(text)


def test_sample_has_the_published_ranges():
    wake = read_wake(SLAB, time=40.0)
    assert wake.v.shape == (1, 110, 70)
    assert (float(wake.y[0]), float(wake.z[0])) == (-54.5, -94.5)
    assert 0.62 <= float(wake.aerosol.min()) and float(wake.aerosol.max()) <= 1.31
    assert -13.1 <= float(wake.w.min()) and float(wake.v.max()) <= 11.4


def test_a_minus_sign_changes_the_sign(write):
    """A file whose y points to starboard: the same air, mirrored back."""
    data = example()
    starboard = data.assign(v=-data["v"]).assign_coords(y=("y", -Y, {"units": "m"}))
    starboard["v"].attrs = starboard["w"].attrs = {"units": "m s-1"}
    path = write(starboard)
    found = read_wake(path, 1.0, {"y": "-y", "v": "- v"})
    expected = read_wake(write(data, name="port.nc"), 1.0)
    xr.testing.assert_allclose(found, expected.assign_attrs(found.attrs))
    with pytest.raises(InputError, match=r"wake.names.tracer: '-tracer'.* of x, y, z, u, v, w"):
        read_wake(path, 1.0, {"tracer": "-tracer"})
    fails(path, "variable 'V' (v) is missing", time=1.0, names={"v": "-V"})
