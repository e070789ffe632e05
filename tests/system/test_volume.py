"""Wind in three dimensions from the experiment file to the report.

Detects a chain that does not run or leaves something out, gates put in the wrong place (the beams'
spread or the flight would show as wind), air that does not move along x, and descriptions of which
no volume can be made."""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.figures.volume import draw_all
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.run import prepare, run
from lidar_mi.experiment.stages import volume as volume_chain
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.retrieval.images.common_grid import resample
from lidar_mi.schema import reading as config
from tests.support import figure_rules

SCENES = Path(str(files("lidar_mi.scenes")))

# ten gates of a coarse wake
SMALL = {
    "name": "small",
    "wake": {"file": "middle.nc", "time": "40 s", "depth": "volume", "x": "20 m", "spacing": "1 m"},
    "platform": {"dt": "0.2 s"},
    "scan": {"range": "495 m", "thickness": "10 m", "gate_count": 10},
    "render": {"samples_per_beam": 240, "max_order": 1},
    "volume": {"methods": ["correlation"], "stride": 2},
}


def changed(**sections):
    data = json.loads(json.dumps(SMALL))
    for section, values in sections.items():
        data[section] = values if values is None else data.get(section, {}) | values
    return config.check(data, "small.yaml")


@pytest.fixture(scope="module")
def air(tmp_path_factory):
    """A folder with the inner 60 x 50 m of the shipped wake: half of its nodes."""
    folder = tmp_path_factory.mktemp("air")
    with xr.open_dataset(SCENES / "wake_volume_40s.nc", engine="h5netcdf") as wake:
        wake.isel(y=slice(25, 85), z=slice(10, 60)).to_netcdf(
            folder / "middle.nc", engine="h5netcdf"
        )
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_the_whole_chain(tmp_path, air):
    with figure_rules.judged_figures() as figures:
        metrics = run(changed(), tmp_path / "run", beside=air).metrics
    assert "fig31_wind_in_three_dimensions" in figures and not any(figures.values()), figures
    wind = xr.open_dataset(tmp_path / "run" / "wind_volume.nc", engine="h5netcdf")
    assert wind["u"].dims == ("source", "algorithm", "x", "z", "y")
    assert wind.attrs["Conventions"] == "CF-1.11" and {"u_stderr", "w_true"} <= set(wind)
    # a 1 m grid has little texture, yet most of the wind is found
    key = "backscatter.correlation"
    assert metrics[f"{key}.valid_fraction"] > 0.85
    for name in "vw":
        assert metrics[f"{key}.rmse_{name}"] < 0.25 * metrics[f"true_wind.rms_{name}"]
    # a telescope 30 m nearer is no wind: 30 m seen as 1 % of spread would be 2.5 m/s at the rim
    good = wind.isel(source=0, algorithm=0).where(wind["flag"].isel(source=0, algorithm=0) == 0)
    for name, axis in (("v", "y"), ("w", "z")):
        off = (good[name] - good[f"{name}_true"]).mean("x")
        slope = float((off * good[axis]).mean() / (good[axis] ** 2).mean())
        assert abs(slope) < 0.01, name
    error = (good["v"] - good["v_true"]).values
    rms = np.sqrt(np.nanmean(error**2))
    assert metrics[f"{key}.rmse_v"] == pytest.approx(rms, rel=1e-3)
    report = (tmp_path / "run" / "report.html").read_text()
    for text in ("Wind in three dimensions", "10 slabs of 1 m", "rms standard error, as stated"):
        assert text in report, text
    # without a valid vector there is only what was seen
    volume = xr.DataArray(np.random.default_rng(1).random((4, 5, 6)), dims=("x", "z", "y"))
    volume = volume.assign_coords(x=np.arange(4.0), z=np.arange(5.0), y=np.arange(6.0))
    with figure_rules.judged_figures() as figures:
        draw_all(tmp_path, wind.assign(flag=wind["flag"] * 0 + 1), [volume] * 2, [], Log())
    assert figures == {"fig30_volume": []}


def test_gates_are_put_where_their_air_is():
    """A pattern in space, seen by diverging beams: on the grid it is itself, at both times."""
    lidar, axis = BackscatterLidar(), np.arange(-30, 31.0)
    scan = Scan(range=200.0, thickness=8.0, gate_count=8)
    plans = plan_scans(scan, axis, axis, (0.0, 30.0))
    nodes = (200.5 + np.arange(8), np.arange(-25, 26.0), np.arange(-25, 26.0))

    def pattern(x, z, y):
        return 1 + 0.5 * np.sin(x / 3) * np.cos(z / 4) * np.sin(y / 5)

    for plan in plans:
        middle = plan.gate_start + 0.5 + np.arange(8)
        reach = middle[:, None, None] / plan.centre
        observed = pattern(
            middle[:, None, None] + plan.position, reach * axis[:, None], reach * axis
        )
        # the lidar equation, by hand
        oblique = np.sqrt(1 + (axis[:, None] ** 2 + axis**2) / plan.centre**2)
        r = middle[:, None, None] * oblique
        s0 = observed * lidar.aperture_area * oblique * np.exp(-2e-4 * r) / r**2
        s0 = xr.DataArray(s0, dims=("gate", "z", "y"))
        found = volume_chain.scan_volume(s0, plan, lidar, 1e-4, nodes)
        expected = pattern(*np.meshgrid(*nodes, indexing="ij"))
        np.testing.assert_allclose(found.transpose("x", "z", "y"), expected, atol=1e-3)
    with pytest.raises(AssertionError):  # the test can fail: a scan referred to the wrong place
        wrong = volume_chain.scan_volume(
            s0,
            replace(plan, gate_start=plan.gate_start + 8, gate_stop=plan.gate_stop + 8),
            lidar,
            1e-4,
            nodes,
        )
        np.testing.assert_allclose(wrong, expected, atol=1e-3)


def test_the_noise_told_is_that_of_long_waves():
    """White noise, resampled, has its spectral density in waves of 8 nodes and more."""
    axis = np.arange(-60, 61.0)
    (plan,) = plan_scans(Scan(range=200.0, thickness=8.0, gate_count=8), axis, axis, (0.0,))
    nodes = (200.5 + np.arange(8), np.arange(-50, 51.0), np.arange(-50, 51.0))
    random, level = np.random.default_rng(3), 1 + np.arange(8)[:, None, None]
    errors = level * np.ones((8, 121, 121))
    told = volume_chain.noise_map(errors, plan, nodes).values
    np.testing.assert_allclose(told, np.broadcast_to(level, told.shape), rtol=1e-12)
    reach = (plan.gate_start + 0.5 + np.arange(8)) / plan.centre
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(101), np.fft.fftfreq(101)))
    for gate in (0, 7):
        noise = level[gate] * random.standard_normal((121, 121))
        places = {n: (n, reach[gate] * axis, {"units": "m"}) for n in "zy"}
        image = resample(xr.DataArray(noise, places, ("z", "y")), *nodes[:0:-1])
        power = np.abs(np.fft.fft2(image.values)) ** 2 / 101**2
        density = power[(frequency > 0) & (frequency < 1 / 8)].mean()
        assert density == pytest.approx(told[gate].mean() ** 2, rel=0.15)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"scan": {"gate_count": 1}}, "scan.gate_count: 1 is not allowed with volume"),
        ({"scan": {"gates": "spherical"}}, "scan.gates: spherical"),
        ({"wake": {"depth": "plane"}}, "volume: not allowed without a wake in three dimensions"),
        ({"wake": {"second": "40.2 s"}}, "wake.second: 40.2 s is not allowed with volume"),
        (
            {"retrieval": {"methods": ["cc"]}, "volume": {"stride": 1}, "wake": {"x": "21 m"}},
            "retrieval: not allowed with volume",
        ),
        ({"volume": {"methods": ["correlation", "correlation"]}}, "methods: 'correlation' twice"),
        ({"volume": {"template": 2}}, "volume.template: 2"),
    ],
)
def test_bad_descriptions_are_named(sections, message):
    with pytest.raises(InputError) as error:
        changed(**sections)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("sections", "start"),
    [
        ({"scan": {"range": "480 m", "thickness": "40 m"}}, "scan.thickness: gates from 480"),
        pytest.param({"volume": {"search": 8}}, "search: 8 voxels", marks=pytest.mark.slow),
    ],
)
def test_inconsistent_settings_are_reported_ahead(sections, start, air):
    with pytest.raises(InputError) as error:
        prepare(changed(**sections), air)
    assert str(error.value).startswith(start) and "\n" not in str(error.value)
