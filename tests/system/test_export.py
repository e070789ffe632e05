"""Results for other programs: VTK read by its own library, CSV by pandas, MATLAB's by scipy.

Detects: values, places, flags, NaN or standard errors that differ from the run's files, axes in
another order, a file replaced unasked. System tier.
"""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.io import loadmat

import lidar_mi as lm
from lidar_mi.io.exr import label_scan, write_scan
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.openfast import write_openfast
from lidar_mi.io.yaml import to_yaml

READERS = {
    ".vti": "vtkXMLImageDataReader",
    ".vts": "vtkXMLStructuredGridReader",
    ".vtu": "vtkXMLUnstructuredGridReader",
}


def axis(values):
    return values, {"units": "m"}


def numbers(*shape, seed=1):
    return np.random.default_rng(seed).normal(size=shape)


def speeds(dims, *shape, seed=1):
    return dims, numbers(*shape, seed=seed), {"units": "m s-1"}


FLAG = {"flag_masks": np.array([1, 2, 4], "int16"), "flag_meanings": "rim faint outlier"}


@pytest.fixture
def folder(tmp_path):
    """A run folder as far as an export reads it; every number differs from all others."""
    run = tmp_path / "run"
    run.mkdir()
    settings = {"name": "mine", "scan": {"range": "148.75 m", "thickness": "2.5 m"}}
    (run / "experiment.yaml").write_text(to_yaml({"experiment": settings, "versions": {}}))
    y, z = np.arange(5) - 1.5, 0.5 * np.arange(4)
    dims = "source", "algorithm", "z", "y"
    v = numbers(2, 2, 4, 5)
    v[1, 0, 2, 3] = np.nan
    flag = np.zeros(v.shape, "int16")
    flag[1, 0, 2, 3] = 5
    wind = xr.Dataset(
        {
            "v": (dims, v, {"units": "m s-1"}),
            "w": speeds(dims, *v.shape, seed=2),
            "v_stderr": speeds(dims, *v.shape, seed=3),
            "flag": (dims, flag, FLAG),
            "v_true": speeds(("z", "y"), 4, 5, seed=4),
        },
        {
            "source": ["air", "light"],
            "algorithm": ["cc", "ws"],
            "y": ("y", *axis(y)),
            "z": ("z", *axis(z)),
        },
    )
    write_netcdf(wind, run / "wind.nc")
    x = 100.0 + 2 * np.arange(3)
    dims = "source", "algorithm", "x", "z", "y"
    volume = xr.Dataset(
        {
            name: speeds(dims, 1, 1, 3, 4, 5, seed=seed)
            for seed, name in enumerate(["u", "v", "w", "u_stderr"])
        },
        {"source": ["air"], "algorithm": ["cc"], "x": ("x", *axis(x)), **wind[["y", "z"]].coords},
    )
    write_netcdf(volume, run / "wind_volume.nc")
    directions = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0.8, 0, -0.6]])
    lines = xr.Dataset(
        {
            "v_los": speeds("line", 3),
            "v_los_std": speeds("line", 3, seed=2),
            "range": ("line", *axis([100.0, 200.0, 300.0])),
            "range_bin": ((), *axis(10.0)),
            "platform_velocity": ("axis", [70.0, 0, 0], {"units": "m s-1"}),
        },
        {"axis": list("xyz"), "direction": (("line", "axis"), directions)},
    )
    write_netcdf(lines, run / "lines_of_sight.nc")
    for name, count, telescope in (("image_t1", 1, 0.0), ("image_t2", 2, 7.0)):
        layers = {n: (("gate", "z", "y"), numbers(count, 4, 5)) for n in ("S0", "S1", "S2", "S3")}
        layers["S0_stderr"] = ("gate", "z", "y"), numbers(count, 4, 5, seed=9) ** 2
        about = {
            "gate_start": 100.0,
            "gate_stop": 104.0,
            "gate_kind": "planar",
            "telescope_position": telescope,
        }
        scan = xr.Dataset(
            {**layers, "Y": (("z", "y"), numbers(4, 5))},
            {"gate": np.arange(count), "y": y, "z": z},
            about,
        )
        write_scan(run / f"{name}.exr", label_scan(scan))
    pair = [300.0, np.log(3.0), 15.0, 1.0, -310.0, np.log(4.0), -16.0, 2.0, 0.5, -0.5]
    fit = lm.VortexPairFit(np.array(pair), np.eye(10), "lamb_oseen", 1.0, 1.0, 0.0, 0.0)
    lm.write_vortices(run / "vortex.json", {"images": fit})
    return run


def read_vtk(path):
    """Places (points, 3) and arrays by name, as VTK has them."""
    vtk = pytest.importorskip("vtk", reason="VTK's own reader is not installed")
    from vtk.util.numpy_support import vtk_to_numpy

    reader = getattr(vtk, READERS[path.suffix])()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    places = np.array([data.GetPoint(k) for k in range(data.GetNumberOfPoints())])
    held = data.GetPointData()
    count = held.GetNumberOfArrays()
    arrays = {held.GetArrayName(k): vtk_to_numpy(held.GetArray(k)) for k in range(count)}
    return places, arrays


def assert_same_at(places, values, truth):
    """Every point of a grid, looked up in the data set by its own coordinates."""
    x, y, z = (xr.DataArray(places[:, k], dims="point") for k in range(3))
    at = {"x": x, "y": y, "z": z}
    found = truth.sel({n: v for n, v in at.items() if n in truth.dims}, method="nearest")
    np.testing.assert_array_equal(values, found.values)
    for name in set(at) & set(truth.dims):
        np.testing.assert_allclose(at[name], found[name], atol=1e-9)


@pytest.mark.slow
def test_winds_and_volumes_in_vtk_are_those_of_the_run(folder):
    paths = {path.name: path for path in lm.export(folder)}
    assert {n for n in paths if n.startswith("wind")} == {
        *(f"wind_{s}_{m}.vti" for s in ("air", "light") for m in ("cc", "ws")),
        "wind_volume_air_cc.vti",
    }
    wind = xr.load_dataset(folder / "wind.nc")
    for source, method in (("light", "cc"), ("air", "ws")):
        places, arrays = read_vtk(paths[f"wind_{source}_{method}.vti"])
        one = wind.sel(source=source, algorithm=method)
        assert set(places[:, 0]) == {150.0}
        for name in ("v", "w", "v_stderr", "v_true"):
            assert_same_at(places, arrays[f"{name} [m s-1]"], one[name])
        assert_same_at(places, arrays["flag"], one["flag"])
        assert_same_at(places, arrays["wind [m s-1]"][:, 2], one["w"])
    assert np.isnan(wind["v"]).sum() == 1
    places, arrays = read_vtk(paths["wind_volume_air_cc.vti"])
    volume = xr.load_dataset(folder / "wind_volume.nc").isel(source=0, algorithm=0)
    assert len(places) == 60
    for k, name in enumerate("uvw"):
        assert_same_at(places, arrays[f"{name} [m s-1]"], volume[name])
        assert_same_at(places, arrays["wind [m s-1]"][:, k], volume[name])


def test_images_lie_where_their_beams_meet_the_gates(folder):
    """The second image has two gates, of middles 101 and 103 m, from a telescope at x = 7 m."""
    paths = {path.name: path for path in lm.export(folder)}
    first, second = (lm.read_scan(folder / f"image_t{k}.exr") for k in (1, 2))
    first = first.squeeze("gate", drop=True)
    places, arrays = read_vtk(paths["image_t1.vti"])
    assert set(places[:, 0]) == {102.0}
    for name, unit in (("S0", "1"), ("S0_stderr", "1"), ("Y", "m-1 sr-1")):
        assert_same_at(places, arrays[f"{name} [{unit}]"], first[name])
    places, arrays = read_vtk(paths["image_t2.vts"])
    for gate, x in enumerate((101.0, 103.0)):
        inside = np.isclose(places[:, 0], 7 + x)
        assert inside.sum() == 20
        plane = places[inside] / [1, x / 102, x / 102]  # to the plane of the pixels
        assert_same_at(plane, arrays["S0 [1]"][inside], second["S0"].isel(gate=gate, drop=True))


def test_lines_of_sight_and_vortices_are_points(folder):
    paths = {path.name: path for path in lm.export(folder)}
    places, arrays = read_vtk(paths["lines_of_sight.vtu"])
    np.testing.assert_allclose(places, [[100, 0, 0], [160, 120, 0], [240, 0, -180]])
    np.testing.assert_array_equal(arrays["v_los [m s-1]"], numbers(3))
    np.testing.assert_array_equal(arrays["v_los_std [m s-1]"], numbers(3, seed=2))
    places, arrays = read_vtk(paths["vortices_images.vtu"])
    np.testing.assert_allclose(places, [[150, 15, 1], [150, -16, 2]])
    np.testing.assert_allclose(arrays["circulation [m2 s-1]"], [300, -310])
    np.testing.assert_allclose(arrays["core_radius [m]"], [3, 4])
    np.testing.assert_allclose(arrays["circulation_stderr [m2 s-1]"], 1)
    np.testing.assert_allclose(arrays["mean_v [m s-1]"], 0.5)


def test_a_row_of_csv_is_a_vector_with_its_flags_in_words(folder, tmp_path):
    lm.export(folder, "csv", tmp_path / "tables")
    table = pd.read_csv(tmp_path / "tables" / "wind.csv")
    wind = xr.load_dataset(folder / "wind.nc")
    assert list(table)[:5] == ["source", "algorithm", "x [m]", "y [m]", "z [m]"]
    assert len(table) == wind["v"].size
    row = table[table["flag"] != 0].squeeze()
    assert (row["source"], row["algorithm"], row["y [m]"], row["z [m]"]) == ("light", "cc", 1.5, 1)
    assert row["flag in words"] == "rim outlier" and np.isnan(row["v [m s-1]"])
    assert set(table["flag in words"]) == {"valid", "rim outlier"}
    index = table.set_index(["source", "algorithm", "z [m]", "y [m]"]).sort_index()
    for name in ("v", "w", "v_stderr"):
        found = index[f"{name} [m s-1]"].to_numpy().reshape(wind["v"].shape)
        np.testing.assert_allclose(found, wind[name], rtol=1e-15)
    lines = pd.read_csv(tmp_path / "tables" / "lines_of_sight.csv")
    np.testing.assert_allclose(lines["y [m]"], [0, 120, 0])
    assert len(pd.read_csv(tmp_path / "tables" / "image_t2.csv")) == 40


def test_matlab_has_arrays_units_and_reasons(folder):
    paths = {path.name: path for path in lm.export(folder, "mat")}
    found = loadmat(paths["wind.mat"], simplify_cells=True)
    wind = xr.load_dataset(folder / "wind.nc")
    for name in ("v", "w", "v_stderr", "flag", "y", "z"):
        np.testing.assert_array_equal(found[name], wind[name])
    assert found["units"]["v_stderr"] == "m s-1" and found["units"]["y"] == "m"
    assert list(found["dims"]["v"]) == ["source", "algorithm", "z", "y"]
    assert list(found["source"]) == ["air", "light"]
    assert list(found["flag_meanings"]["flag"]) == ["rim", "faint", "outlier"]


def test_export_refuses_in_one_line(folder, tmp_path, monkeypatch, lidar_mi):
    monkeypatch.chdir(tmp_path)
    for args, words in (
        (["run", "--format", "xls"], ("format", "xls", "vtk, csv, mat")),
        (["."], ("no experiment.yaml", "expected a run folder")),
        (["nowhere"], ("nowhere", "expected a run folder")),
    ):
        code, _, err = lidar_mi("export", *args)
        assert code == 2 and len(err.splitlines()) == 1
        assert all(word in err for word in words)
    lm.export(folder, "csv")
    (folder / "csv" / "wind.csv").write_text("mine")
    with pytest.raises(lm.InputError, match="exists; expected another folder"):
        lm.export(folder, "csv")
    assert (folder / "csv" / "wind.csv").read_text() == "mine"
    lm.export(folder, "csv", overwrite=True)
    assert (folder / "csv" / "wind.csv").read_text() != "mine"


@pytest.fixture
def stare(tmp_path):
    """A short run of a coherent lidar that looks upwind, to the north-east and 10 degrees up."""
    keys = {"azimuth": "45 deg", "elevation": "10 deg", "count": 4}
    experiment = lm.load_experiment(
        "inflow", **{f"doppler.scan.{key}": value for key, value in keys.items()}
    )
    return lm.run(experiment, tmp_path / "stare").folder


def test_lines_of_a_coherent_lidar_are_points_to_the_east_north_and_up(stare):
    lines = xr.load_dataset(stare / "lines_of_sight.nc")
    table = pd.read_csv(lm.export(stare, "csv")[0])
    assert len(table) == lines["radial_velocity"].size
    level = table["range [m]"] * np.cos(np.radians(10))
    np.testing.assert_allclose(table["x [m]"], level / np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(table["y [m]"], level / np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(table["z [m]"], table["range [m]"] * np.sin(np.radians(10)))
    assert list(table["time [s]"].unique()) == [0, 1, 2, 3]
    np.testing.assert_allclose(
        table.set_index(["time [s]", "range [m]"])["radial_velocity [m s-1]"].to_numpy(),
        lines["radial_velocity"].transpose("time", "range").values.ravel(),
    )
    names = [path.name for format in ("vtk", "mat") for path in lm.export(stare, format)]
    assert names == ["lines_of_sight.vtu", "lines_of_sight.mat"]


def test_openfast_reads_the_wind_towards_the_lidar(stare, folder):
    """Eight lines of head: names in the seventh and units in brackets in the eighth."""
    (path,) = lm.export(stare, "openfast")
    assert path.name == "lines_of_sight.out"
    head = path.read_text().splitlines()[:8]
    assert head[6].split() == ["Time", *(f"WindMeas{k}" for k in range(1, 7))]
    assert head[7].split() == ["(s)", *["(m/s)"] * 6]
    table = np.loadtxt(path, skiprows=8)
    lines = xr.load_dataset(stare / "lines_of_sight.nc").transpose("time", "range")
    expected = -lines["radial_velocity"].values / np.cos(np.radians(10))
    np.testing.assert_allclose(table[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(table[:, 1:], expected, rtol=1e-5)
    # half of the 10 m/s is seen at 45 degrees and more
    assert 5 < table[:, 1:].mean() < 9
    with pytest.raises(lm.InputError, match="no lines of a coherent lidar"):
        lm.export(folder, "openfast")


def test_lines_of_several_directions_are_no_measurement_of_openfast(stare):
    lines = xr.load_dataset(stare / "lines_of_sight.nc")
    turned = lines.assign_coords(azimuth=("time", np.array([0.0, 90, 180, 270])))
    with pytest.raises(lm.InputError, match="several directions"):
        write_openfast("a.out", turned)
    up = lines.assign_coords(elevation=("time", np.full(4, 70.0)))
    with pytest.raises(lm.InputError, match="elevation of 70 deg"):
        write_openfast("a.out", up)
