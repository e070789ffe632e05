"""Both lidars as one sensor, from the experiment file to the report.

Detects a chain that does not run or leaves something out, lines of sight that are read wrongly or
with wrong errors (4 sigma), a verdict that contradicts its numbers, and descriptions of lidars that
do not look at the same air."""

import json
import math
import shutil
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.requirements import (
    Requirement,
    RequirementTable,
    read_requirements,
)
from lidar_mi.assessment.metrics.sensor import limit_metrics, vector_metrics
from lidar_mi.assessment.report import sensor as sensor_report
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.measure import judged
from lidar_mi.experiment.preflight import check
from lidar_mi.experiment.run import prepare, run
from lidar_mi.experiment.stages.sensor import combine_settings, mean_squares_without, with_truth
from lidar_mi.instrument.doppler_scan import scan_wind
from lidar_mi.io.vortex_file import read_vortices
from lidar_mi.schema import reading as config
from tests.support.experiments import (
    QUICK_DOPPLER,
    leave_out_figures,
    replace_stages,
    without_figures,
)

# a coarse wake, single scattering, a CCD of a sixteenth of the pixels
SMALL = {
    "name": "small",
    "wake": {"file": "wake_slab_40s.nc", "time": "40 s", "spacing": "1 m"},
    "platform": {"speed": "70 m/s"},
    "lidar": {"pulse_duration": "10 ns"},
    "scan": {"range": "148.75 m"},
    "render": {"samples_per_beam": 64, "max_order": 1},
    "retrieval": {"methods": ["cc"], "stride": 2},
    "doppler": {"lidar": {"range": "150 m"}} | QUICK_DOPPLER,
    "sensor": {
        "directions": {
            "columns": 5,
            "rows": 3,
            "azimuth_half": "14 deg",
            "elevation_half": "8 deg",
        },
        "method": "cc",
        "crossflow_std": "0.8 m/s",
    },
}


def combined(experiment, truth, lines, crossflow):
    """The wind of both lidars as a run has it."""
    settings = call(combine_settings, experiment, crossflow=crossflow)
    return with_truth(experiment.name, experiment.scan, truth, lines, crossflow, settings)


def changed(**sections):
    data = json.loads(json.dumps(SMALL))
    for section, values in sections.items():
        data[section] = values if values is None else data.get(section, {}) | values
    return config.check(data, "small.yaml")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder and metrics of one run, without the figures that each lidar has alone."""
    mi.set_variant("llvm_ad_mono_polarized")
    folder = tmp_path_factory.mktemp("whole") / "run"
    with without_figures(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidar_mi.assessment.figures.doppler.draw_all", lambda *_: [])
        return folder, run(changed(), folder).metrics


@pytest.mark.slow
def test_the_whole_chain(whole):
    folder, metrics = whole
    lines = xr.open_dataset(folder / "lines_of_sight.nc", engine="h5netcdf")
    wind = xr.open_dataset(folder / "wind3d.nc", engine="h5netcdf")
    assert lines.sizes["line"] == 15 == metrics["sensor.lines_retrieved"]
    assert wind.attrs["Conventions"] == "CF-1.11" and {"u", "v", "w", "u_true"} <= set(wind)
    # read from rings, with the errors that the fit states
    normalised = (lines.v_los - lines.v_los_true) / lines.v_los_std
    assert abs(float(normalised.mean())) < 4 / math.sqrt(15)
    assert float((normalised**2).mean()) < 1 + 4 * math.sqrt(2 / 15)
    # u of the combined sensor is what the lines are good for; triples are not
    assert metrics["sensor.rmse_u"] < 0.5 < metrics["sensor.triples.rmse_v"]
    valid = wind["flag"].values == 0
    error = (wind["u"] - wind["u_true"]).values[valid]
    assert metrics["sensor.rmse_u"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-3)
    # the verdict is that of the numbers
    margin = 1 - metrics["sensor.outside_cores.rmse_w"] / 2.5
    assert metrics["sensor.flight_control.landing.error_w.margin"] == pytest.approx(margin)
    assert metrics["sensor.doppler.pulses_per_second"] == 15 * 10 * 20
    assert metrics["sensor.backscatter.pulses_per_second"] == 110 * 70 * 10  # a beam a node
    # the paper's table asks for 0.5 m/s along a line
    needed = 20 * float((lines.v_los_std**2).mean()) / 0.5**2
    assert metrics["sensor.doppler.pulses_needed"] == math.ceil(needed)
    # nine lines, wider apart, hold v and w better than three
    assert metrics["sensor.neighbours.rmse_v"] < metrics["sensor.triples.rmse_v"]
    report = (folder / "report.html").read_text()
    for text in (
        "flight control, from wind vectors, landing",
        "Cruise (from 129 m/s): not assessed at 70 m/s.",
        "at most 2.5 m/s",
        "safe for eyes beyond",
        "0.002 J/m² per pulse",
        "up to nine by least squares",
        "the required error of v_LOS needs 1 pulse per direction",
        "The images require 77000 pulses per second",
        "the look-ahead time is 2.1 s",
        "u has an rms error of",
        "The wind from both lidars",
    ):
        assert text in report, text
    for name in ("fig19_lines_of_sight", "fig20_wind3d", "fig22_vortices"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5_000
    assert "wind vectors, cruise" not in report
    # the answer and the verdict, then images, then numbers
    order = [
        '<div class="answer">',
        "data:image",
        'id="verdict-1"',
        'class="pass"',
        'href="wind3d.nc"',
        "<canvas",
        "figcaption",
        'id="numbers-1"',
        "All numbers",
    ]
    places = [report.index(text) for text in order[:-3]]
    places += [report.index(text, places[-1]) for text in order[-3:]]
    assert places == sorted(places)


@pytest.mark.parametrize("name", ["wind3d.nc", "wind.nc", "lines_of_sight.nc", "v_los.nc"])
def test_files_keep_the_conventions(whole, name):
    """CF 1.11: coordinate variables without missing values (2.5.1), everything that counts with a
    unit (3.1) and a name (3.2), flags with masks of their own type (3.5), the axes named (4)."""
    with xr.open_dataset(whole[0] / name, engine="h5netcdf", decode_cf=False) as data:
        assert data.attrs["Conventions"] == "CF-1.11" and data.attrs["title"]
        for key, variable in data.variables.items():
            if key in data.dims:
                assert "_FillValue" not in variable.attrs, key
            if variable.dtype.kind in "US" or variable.dtype == object:
                continue
            assert variable.attrs.get("long_name"), key
            if "flag_masks" in variable.attrs:
                masks = np.ravel(variable.attrs["flag_masks"])
                assert masks.dtype == variable.dtype
                assert len(masks) == len(variable.attrs["flag_meanings"].split())
            else:
                assert variable.attrs.get("units"), key
        axes = {
            axis: data[axis].attrs.get("axis") for axis in ("x", "y", "z") if axis in data.variables
        }
        assert all(found == axis.upper() for axis, found in axes.items())
        if name == "wind3d.nc":
            assert set(axes) == {"x", "y", "z"} and float(data["x"]) == 150


def test_the_vortices_are_reported_and_saved(whole):
    """On a grid of 1 m: circulation to 10 %, places to 1 m; the file says the same."""
    folder, metrics = whole
    fit = read_vortices(folder / "vortex.json")["images"]
    for name in ("port_circulation_5_15", "starboard_circulation_5_15"):
        assert metrics[f"vortex.images.{name}"] == pytest.approx(fit.quantities[name].value)
        assert metrics[f"vortex.images.{name}"] == pytest.approx(
            metrics[f"vortex.truth.{name}"], rel=0.1
        )
    assert abs(metrics["vortex.images.port_y"] - metrics["vortex.truth.port_y"]) < 1
    with xr.open_dataset(folder / "wind3d.nc", engine="h5netcdf") as wind:
        model = fit.wind(wind.y.values[None, :], wind.z.values[:, None])
        rmse = np.sqrt(((model["w"].values - wind["w_true"].values) ** 2).mean())
    # a grid a little smaller than the slab
    assert metrics["vortex.images.rmse_w"] == pytest.approx(rmse, rel=0.2)
    assert (
        "From the images, the errors of the circulations are"
        in (folder / "report.html").read_text()
    )


def again(whole, tmp_path, monkeypatch, spoil):
    """The same run with its images as they are and its winds spoilt: the report's text."""
    folder, _ = whole
    shutil.copytree(folder, tmp_path / "run")
    (tmp_path / "run" / "wind3d.nc").write_text("of another run")
    kept = xr.open_dataset(folder / "lines_of_sight.nc", engine="h5netcdf").load()
    wind = xr.open_dataset(folder / "wind.nc", engine="h5netcdf").load()
    wind, kept = spoil(wind, kept)

    without = dict.fromkeys(("ring_images", "lit_rings", "v_los", "ring_budget", "exposure"))
    replace_stages(monkeypatch, lines=lambda *_, log: kept, wind=lambda *_, log: wind, **without)
    leave_out_figures(monkeypatch)
    run(changed(), tmp_path / "run")
    return (tmp_path / "run" / "report.html").read_text(), tmp_path / "run"


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_no_valid_vector_is_reported_and_the_rest_is_shown(whole, tmp_path, monkeypatch):
    report, folder = again(
        whole,
        tmp_path,
        monkeypatch,
        lambda wind, lines: (wind.assign(flag=xr.full_like(wind["flag"], 4)), lines),
    )
    assert "Warning: no wind from both lidars: crossflow" in report
    assert "no vortex pair from the wind vectors: vectors: no valid vectors" in report
    # what there is: the scan, the verdict on it, the pair in the images
    for text in (
        "The scan of the Doppler lidar",
        "at most 2.5 m/s",
        "not judged: not measured",
        "From the images, the errors of the circulations are",
    ):
        assert text in report, text
    assert not (folder / "wind3d.nc").exists()
    assert set(read_vortices(folder / "vortex.json")) == {"images"}
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["sensor.vectors"] == 0 and metrics["sensor.lines_retrieved"] == 15
    assert "sensor.triples.rmse_u" in metrics and "sensor.rmse_u" not in metrics


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_two_lines_give_no_vector_which_is_reported(whole, tmp_path, monkeypatch):
    report, folder = again(
        whole,
        tmp_path,
        monkeypatch,
        lambda wind, lines: (
            wind,
            lines.assign(v_los=lines["v_los"].where(np.arange(15) % 14 == 0)),
        ),
    )
    assert (
        "Warning: no vector from both lidars is valid; 100 % have the flag beyond_lines" in report
    )
    assert "no wind from lines of sight alone: no three neighbouring lines could" in report
    # the scan and the vectors that were rejected, but no figures of nothing
    assert (
        "The scan of the Doppler lidar" in report
        and "2 of 15 lines of sight were retrieved" in report
    )
    assert "Standard errors of the wind" not in report and '"beyond lines"' in report
    with xr.open_dataset(folder / "wind3d.nc", engine="h5netcdf") as wind:
        assert (wind["flag"].values != 0).all()


def test_errors_of_a_known_field():
    """u off by its standard error, v by twice, w by 3 at one node of ten within a core."""
    axes = {"z": np.zeros(1), "y": np.arange(10.0)}
    one = xr.DataArray(np.ones((1, 10)), coords=axes, dims=("z", "y"))
    spot = one * (one.y == 0)
    found = xr.Dataset(
        {
            "u": 5 + 0.5 * one,
            "v": 2 * one,
            "w": 3 * spot,
            "u_true": 5 * one,
            "v_true": 0 * one,
            "w_true": 0 * one,
            "u_stderr": 0.51 * one,
            "v_stderr": one,
            "w_stderr": one,
            "flag": (2 * one * (one.y == 9)).astype(np.uint8),
        }
    )
    metrics = vector_metrics(found, [Core(y=0.0, z=0.0, radius=0.3, circulation=400.0)])
    assert metrics["sensor.vectors"] == 9 and metrics["sensor.valid_fraction"] == 0.9
    assert metrics["sensor.spanned_fraction"] == 0.9  # the last one is beyond the lines
    assert metrics["sensor.rmse_u"] == pytest.approx(0.5) == metrics["sensor.bias_u"]
    assert metrics["sensor.coverage_68_u"] == 1 and metrics["sensor.coverage_95_v"] == 0
    assert metrics["sensor.normalised_error_variance_v"] == pytest.approx(4)
    assert metrics["sensor.rmse_w"] == pytest.approx(1)
    assert (
        metrics["sensor.outside_cores.rmse_w"] == 0 and metrics["sensor.outside_cores.rms_u"] == 5
    )


@pytest.mark.parametrize(
    ("amplitude", "noise", "errors", "limit"),
    [
        (0.0, 0.5, {}, "line_noise"),
        (1.0, 0.01, {}, "sampling"),
        pytest.param(0.0, 0.01, {"yaw": "20 mrad"}, "pointing", marks=pytest.mark.slow),
    ],
)
def test_largest_cause_of_error_of_u_is_reported(amplitude, noise, errors, limit):
    """An even u is limited by the noise of its lines, or by a yaw that is not known; a u of 4 m
    waves by what lies between them."""
    experiment = changed(sensor={"errors": errors})
    y, z = np.arange(-54, 54.1, 1.0), np.arange(-34, 34.1, 1.0)
    waves = amplitude * np.sin(2 * np.pi * z[:, None] / 4) * np.sin(2 * np.pi * y / 4)
    fields = {"u": 2 + waves, "v": 0 * waves, "w": 0 * waves}
    metres = {"units": "m"}
    truth = xr.Dataset(
        {n: (("z", "y"), f) for n, f in fields.items()},
        coords={"y": ("y", y, metres), "z": ("z", z, metres)},
    )
    lines = scan_wind(
        truth,
        experiment.sensor.directions,
        experiment.doppler.lidar,
        noise,
        1,
        70.0,
        experiment.sensor.errors,
    )
    crossflow = truth[["v", "w"]].assign(flag=(("z", "y"), np.zeros(waves.shape, np.uint8)))
    crossflow.attrs = {"template": 4, "stride": 1}
    found = combined(experiment, truth, lines, crossflow)
    metrics = limit_metrics(
        call(
            mean_squares_without,
            experiment,
            truth=truth,
            states=truth,
            line_beams=None,
            lines=lines,
            crossflow=crossflow,
            combined=found,
            cores=[],
        )
    )
    causes = ["line_noise", "range_bin", "crossflow", "sampling", *(["pointing"] if errors else [])]
    fractions = {c: metrics[f"sensor.error_budget.{c}.fraction_u"] for c in causes}
    other = "line_noise" if amplitude else "sampling"
    assert fractions[limit] > 0.9 and fractions[other] < 0.1
    assert abs(fractions["range_bin"]) < 0.1
    output = sensor_report._limit_of_u(metrics | {"sensor.rmse_u": 0.5})
    assert f"limited by {sensor_report._CAUSES[limit]}" in output[0]
    # standard errors do not hold them
    assert bool(sensor_report._not_stated(experiment.sensor.errors)) == bool(errors)


def test_points_are_counted_as_each_table_means_them():
    """Lines of sight for velocities along them; windows that do not overlap for vectors."""
    metrics = {"sensor.lines_retrieved": 15, "sensor.vectors": 1000}
    tables = read_requirements()
    results = {"requirements": tables, "truth": SimpleNamespace(wind={"u"})}
    for table, findings in judged(changed(), results, metrics):
        found = {row.quantity: row.measured for row in findings}
        # (2 / 8)^2 of 1000
        assert found["points_per_slab"] == (15 if table.application == "disturbance" else 62)
        assert found["range"] == 150 and np.isnan(found.get("error_u", np.nan))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"doppler": None}, "sensor: not allowed without wake and doppler"),
        ({"sensor": {"method": "variational"}}, "sensor.method: 'variational' is not allowed"),
        (
            {"sensor": {"crossflow_std": None, "method": "ws"}, "retrieval": {"methods": ["ws"]}},
            "sensor.crossflow_std: missing",
        ),
        ({"sensor": {"directions": {"rows": 0}}}, "sensor.directions.rows: 0"),
        ({"sensor": {"errors": {"yaw": 0.1}}}, "sensor.errors.yaw: 0.1"),
    ],
)
def test_bad_descriptions_are_named(sections, message):
    with pytest.raises(InputError) as error:
        changed(**sections)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("sections", "start"),
    [
        (
            {"doppler": {"lidar": {"range": "56 m"}}},
            "doppler.lidar.range: 56 m is not allowed with",
        ),
        ({"sensor": {"directions": {"azimuth_half": "25 deg"}}}, "sensor.directions: wind: y from"),
        ({"sensor": {"requirements": "mine.yaml"}}, "sensor.requirements: mine.yaml not found"),
        (
            {"platform": {"speed": "1200 m/s"}},
            "platform.speed: 1200 m/s is not allowed with sensor",
        ),
    ],
)
def test_inconsistent_settings_are_reported_ahead(sections, start):
    with pytest.raises(InputError) as error:
        prepare(changed(**sections))
    assert str(error.value).startswith(start) and "\n" not in str(error.value)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("columns", "rows", "reported"), [(5, 3, False), (5, 1, True), (1, 3, True)]
)
def test_a_check_reports_lines_in_one_plane(columns, rows, reported):
    directions = SMALL["sensor"]["directions"] | {"columns": columns, "rows": rows}
    found = dict(check.sections(changed(sensor={"directions": directions})))
    (_, lines), *_ = found["both as one sensor"]
    assert lines.startswith(f"{columns * rows}, 20 pulses each")
    assert ("in one plane: no wind" in lines) == reported


@pytest.mark.parametrize(
    ("start", "limits", "expected"),
    [
        (150.0, {"maximum": 150.0}, 150.0),
        (149.0, {"minimum": 151.5}, 151.5),
        (160.0, {"maximum": 150.0}, 161.25),
        (100.0, {"minimum": 150.0}, 101.25),
    ],
)
def test_a_range_is_anywhere_in_the_slab(start, limits, expected):
    table = RequirementTable("a", "a", "landing", (Requirement("range", **limits),))
    metrics = {"sensor.lines_retrieved": 15, "sensor.vectors": 1000}
    results = {"requirements": {0: table}, "truth": SimpleNamespace(wind={"u"})}
    asked = changed(
        scan={"range": f"{start} m", "thickness": "2.5 m"}, doppler={"lidar": {"range": start + 1}}
    )
    ((_, (row,)),) = judged(asked, results, metrics)
    assert row.measured == expected and row.passed == (149 <= start <= 150)
