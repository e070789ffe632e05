"""Everything a run of the demo writes, against what the documentation promises.

Detects: files that are missing or too many, a record that cannot repeat the run, NaN or changed
keys in the metrics, winds that are no CF data set, and images whose attributes do not say what they
show."""

import json
import re
from importlib.resources import files
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml
from PIL import Image

import lidar_mi as lm
from lidar_mi.experiment.folder.run_folder import IMAGES
from lidar_mi.io.exr import read_scan
from lidar_mi.schema import reading as config
from tests.support.experiments import FIGURES, SOURCES

SCENES = Path(str(files("lidar_mi.scenes")))
METHODS = "variational", "cc"
COVERAGE = [f"coverage_{of}_{name}" for of in (68, 95) for name in "vw"]

STATISTICS = [
    f"{statistic}_{name}"
    for statistic in ("rmse", "bias", "p50", "p90")
    for name in ("v", "w", "speed", "direction")
]


def test_everything_a_run_leaves(demo):
    names = {str(p.relative_to(demo.folder)) for p in demo.folder.rglob("*") if p.is_file()}
    assert names == {
        "experiment.yaml",
        "image_t1.exr",
        "image_t1.png",
        "image_t2.exr",
        "image_t2.png",
        "wind.nc",
        "metrics.json",
        "report.html",
        "summary.txt",
        "log.txt",
        *(f"figures/{name}.png" for name in FIGURES),
    }
    log = (demo.folder / "log.txt").read_text().splitlines()
    assert "seed 1" in log[0] and log[-1].endswith("done")


def test_previews_show_the_light_as_the_pilot_sees_it(demo):
    """Grey is linear in the light from its quantile of 0.5 % to that of 99.5 %."""
    for name in ("image_t1", "image_t2"):
        scan = read_scan(demo.folder / f"{name}.exr")
        light = scan["Y"].transpose("z", "y").values[::-1, ::-1]
        grey = np.asarray(Image.open(demo.folder / f"{name}.png"), float)
        black, white = np.quantile(light, (0.005, 0.995))
        expected = 255 * np.clip((light - black) / (white - black), 0, 1)
        np.testing.assert_allclose(grey, expected, atol=0.51)
        assert np.ptp(grey) > 100


def test_the_record_is_enough_to_repeat_the_run(demo):
    record = yaml.safe_load((demo.folder / "experiment.yaml").read_text())
    assert config.check(record["experiment"], "record") == demo.experiment
    assert record["experiment"]["seed"] == 1
    assert {"lidar-mi", "python", "mitsuba", "drjit", "numpy", "torch"} <= set(record["versions"])
    assert len(record["files"]["wake.file"]) == 64  # SHA-256


def test_the_record_is_an_experiment_file(demo):
    assert config.load(demo.folder / "experiment.yaml") == demo.experiment
    changed = config.load(demo.folder / "experiment.yaml", ["seed=7"])
    assert changed.seed == 7 and changed.wake == demo.experiment.wake


def test_every_variable_of_the_winds_is_in_the_user_guide(demo):
    guide = (Path(__file__).parents[2] / "docs" / "guide" / "outputs.md").read_text()
    table = guide[guide.index("`wind.nc`, CF") :].partition("\n`source` ")[0]
    listed = set(re.findall(r"`(\w+)`", "".join(re.findall(r"(?m)^\|([^|]*)\|", table))))
    with xr.open_dataset(demo.folder / "wind.nc") as winds:
        assert listed == set(winds.data_vars)


def test_progress_names_every_step_and_stays_within_bounds(demo):
    texts = " | ".join(text for text, _ in demo.reported)
    for step in (
        "reading the wake",
        "rendering scan 1 of 2",
        "rendering scan 2 of 2",
        "retrieving winds from backscatter",
        "drawing",
        "done",
    ):
        assert step in texts
    assert all(fraction is None or 0 <= fraction <= 1 for _, fraction in demo.reported)


def test_metrics_are_finite_and_their_keys_are_the_agreed_ones(demo):
    def refuse(constant):
        pytest.fail(f"metrics.json holds {constant}")

    text = (demo.folder / "metrics.json").read_text()
    metrics = json.loads(text, parse_constant=refuse)
    assert metrics == demo.metrics
    assert all(isinstance(value, float) and np.isfinite(value) for value in metrics.values())
    expected = {
        f"{source}.{method}.{key}"
        for source, method in product(SOURCES, METHODS)
        for key in (
            "valid_fraction",
            "retrieved_fraction",
            *(f"{part}{s}" for part in ("", "outside_cores.", "all.") for s in STATISTICS),
        )
    }
    expected |= {
        f"{source}.{method}.{key}"
        for source, method, key in product(
            SOURCES, METHODS, ("stderr_v", "stderr_w", "no_skill_fraction", *COVERAGE)
        )
    }
    # the noise of an image that was rendered is known, and so how well a wind can be found in it
    expected |= {
        f"backscatter.{method}.{q}_{name}"
        for method, q, name in product(METHODS, ("bound", "efficiency"), "vw")
    }
    expected |= {
        "backscatter.mc_relative_error",
        "backscatter.samples_per_beam",
        *(
            f"backscatter.{method}.{part}monte_carlo_{name}"
            for method, part, name in product(METHODS, ("", "outside_cores."), "vw")
        ),
        "backscatter.multiple_scattering_fraction",
        "backscatter.depolarization",
        "backscatter.depolarization_stderr",
        *(f"backscatter.fraction.{part}" for part in ("molecules", "background", "exhaust")),
    }
    # images alone are judged in v and w
    expected |= {key for key in metrics if key.startswith("sensor.flight_control.")}
    assert {
        f"sensor.flight_control.cruise.{row}.margin"
        for row in ("range", "slabs_per_second", "points_per_slab", "error_v", "error_w")
    } <= expected
    expected |= {
        f"wake.{side}_core.{q}"
        for side in ("port", "starboard")
        for q in ("y", "z", "radius", "circulation")
    }
    expected |= {
        f"texture_sweep.{level}_percent.{q}"
        for level in (0, 2, 5, 10, 20, 40)
        for q in ("rmse_v", "rmse_w", "valid_fraction")
    }
    expected |= {f"true_wind.{part}rms_{q}" for part in ("", "outside_cores.") for q in "vw"}
    expected |= {f"timing.{step}_s" for step in ("truth", "render", "retrieve", "figures")}
    # no vector of smooth smoke is valid: its statistics are left out
    for none in (f"extinction_without_texture.{method}." for method in METHODS):
        assert metrics[f"{none}valid_fraction"] == 0
        expected -= {f"{none}{part}{s}" for part in ("", "outside_cores.") for s in STATISTICS}
        expected -= {f"{none}{q}" for q in ("stderr_v", "stderr_w", "no_skill_fraction", *COVERAGE)}
    assert set(metrics) == expected


def test_wind_file_is_cf(demo):
    with xr.open_dataset(demo.folder / "wind.nc") as wind:
        assert wind.attrs["Conventions"].startswith("CF-")
        assert wind["v"].dims == ("source", "algorithm", "z", "y")
        assert wind["source"].values.tolist() == list(SOURCES)
        assert wind["algorithm"].values.tolist() == list(METHODS)
        for name, variable in wind.variables.items():
            if variable.dtype.kind == "f":
                assert variable.attrs["units"] in ("m", "m s-1", "s", "1"), name
                assert variable.attrs.get("long_name") or name in wind.coords, name
        for name in ("v", "w", "v_true", "w_true"):
            assert wind[name].attrs["units"] == "m s-1"
        for name in ("y", "z", "y_vector", "z_vector"):
            assert wind[name].attrs["units"] == "m"
        masks = wind["flag"].attrs["flag_masks"]
        assert len(wind["flag"].attrs["flag_meanings"].split()) == len(masks)
        assert not (wind["flag"].values & ~np.bitwise_or.reduce(masks)).any()
        # 219 x 139 pixels hold 204 x 124 regions of 16; a template's centre is between pixels
        assert dict(wind.sizes) == {"source": 4, "algorithm": 2, "z": 124, "y": 204}
        assert float(wind["y"][0]) == pytest.approx(-54.5 + (4 + 3.5) * 0.5)
        valid = (wind["flag"] == 0).values
        for name in ("v", "w", "y_vector", "z_vector", "v_true", "w_true"):
            assert np.isfinite(wind[name].values[valid]).all(), name


def test_metrics_follow_from_the_wind_file(demo):
    with xr.open_dataset(demo.folder / "wind.nc") as wind:
        one = wind.sel(source="backscatter", algorithm="cc")
        error = (one["w"] - one["w_true"]).values[one["flag"].values == 0]
    assert demo.metrics["backscatter.cc.rmse_w"] == pytest.approx(
        np.sqrt(np.mean(error.astype(float) ** 2)), rel=1e-5
    )


def test_images_are_described_by_their_metadata(demo):
    for index, name in enumerate(IMAGES):
        scan = read_scan(demo.folder / name)
        start = 500.0 - 15.0 * index
        assert (scan.attrs["gate_start"], scan.attrs["gate_stop"]) == (start, start + 2.5)
        assert scan.attrs["wavelength"] == pytest.approx(532e-9)
        assert (scan.attrs["platform_speed"], scan.attrs["dt"]) == (150.0, pytest.approx(0.1))
        # scans share their random numbers, as winds follow from them
        assert scan.attrs["seed"] == 1
        assert scan.attrs["samples_per_beam"] == 64
        assert scan.sizes == {"gate": 1, "z": 139, "y": 219}
        for axis, end in (("y", 54.5), ("z", 34.5)):
            values = scan[axis].values
            np.testing.assert_allclose(values[[0, -1]], [-end, end], atol=1e-4)
        assert (scan["S0"].values > 0).all() and (scan["S0_stderr"].values > 0).all()


@pytest.mark.slow
def test_a_single_vector_between_nodes(tmp_path):
    """Of images with room for no more: the true wind there is that of the node beside it."""
    pair = {"circulation": 150, "separation": "8 m", "core_radius": "1 m"}
    wake = {"vortex_pair": pair | {"width": "20 m", "height": "16 m"}, "spacing": "1 m"}
    experiment = lm.load_experiment(
        "wake_backscatter",
        wake={"file": None, "time": None, "second": "advect"} | wake,
        render={"samples_per_beam": 2, "max_order": 1},
        retrieval={"methods": ["cc"], "stride": 8, "sources": "measured"},
    )
    metrics = lm.run(experiment, tmp_path / "out").metrics
    assert np.isfinite(list(metrics.values())).all() and metrics["true_wind.rms_w"] > 1
