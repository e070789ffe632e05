"""A Doppler lidar's experiment, from the etalon to the verdict, through the public `run`.

Detects: rings in the wrong place or moved the wrong way by the wind, winds worse than the Cramer-
Rao bound allows for or biased, a stated uncertainty that is not met, averages whose noise is not
that of averages, a paper's chain without its bias, images that are not used again or not the same
when rendered again, results of another experiment taken for this one's, changed or non-finite
metrics, experiments of both lidars that lose one, and input that only fails later."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import xarray as xr
from scipy import stats
from scipy.constants import speed_of_light

from lidar_mi.assessment.digits import with_error
from lidar_mi.cli.run import run as run_command
from lidar_mi.errors import InputError
from lidar_mi.experiment import run as experiment
from lidar_mi.experiment.run import run
from lidar_mi.experiment.stages.ring_images import summed
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.io.exr import read_fringes
from lidar_mi.schema import reading as config
from lidar_mi.schema.experiment import Experiment
from tests.support.experiments import leave_out_figures, sketched_figures

# 25 % of the default camera's pixels see the same four rings
CAMERA = {"width": 480, "height": 390, "pixel": "14.8 um"}
SPEEDS = (50.0, -300.0)
SMALL = {
    "name": "small",
    "seed": 3,
    "doppler": {
        "v_los": list(SPEEDS),
        "camera": CAMERA,
        "path_samples": 2,
        "retrieval": {
            "methods": ["annular", "pixels", "ca", "ca_r2", "ml", "sg"],
            "averaged": [1, 9],
            "images": 4,
            "slow_images": 1,
        },
    },
}
FILES = set(
    (
        "experiment.yaml fringes_emitted.exr fringes_emitted.png fringes_photons.exr "
        "fringes_photons.png fringes_received_00.exr fringes_received_00.png "
        "fringes_received_01.exr fringes_received_01.png v_los.nc metrics.json report.html "
        "summary.txt log.txt figures"
    ).split()
)
FIGURES = set(
    (
        "fig03_fringes fig04_ring_cuts fig16_doppler_errors fig17_doppler_bias fig18_doppler_speeds"
    ).split()
)


def check(**changes):
    doppler = SMALL["doppler"] | changes
    return config.check(SMALL | {"doppler": doppler}, "small")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Folder and metrics of the small experiment."""
    folder = tmp_path_factory.mktemp("fringes") / "run"
    with sketched_figures():
        return folder, run(check(), folder).metrics


@pytest.fixture(scope="module")
def found(small):
    with xr.open_dataset(small[0] / "v_los.nc", engine="h5netcdf") as data:
        return data.load()


@pytest.fixture
def quick(monkeypatch):
    """Without what only the small experiment is asked for."""
    monkeypatch.setattr("lidar_mi.assessment.figures.doppler.draw_all", lambda *_: [])


QUICK = {
    "path_samples": 0,
    "v_los": [0],
    "render": {"samples_per_pixel": 2},
    "retrieval": {
        "methods": ["annular"],
        "averaged": [1],
        "images": 1,
        "centre": ["known"],
        "slow_images": 0,
    },
}


# ---------------------------------------------------------------- images


def test_images_are_described_by_their_headers(small):
    received = [read_fringes(small[0] / f"fringes_received_{k:02d}.exr") for k in (0, 1)]
    assert [rendered.attrs["v_los"] for rendered in received] == list(SPEEDS)
    photons = read_fringes(small[0] / "fringes_photons.exr")
    assert (photons.attrs["lens"], photons.attrs["estimator"]) == ("singlet", "analog")


# ---------------------------------------------------------------- winds


@pytest.mark.parametrize("centre", ["free", "known"])
@pytest.mark.parametrize("averaged", [1, 9])
def test_winds_scatter_as_the_bound_says(small, found, centre, averaged):
    """Squared errors over the bound's variance follow chi-square: bias and spread at once, 8
    images; to 1e-4 on each side."""
    case = found.sel(algorithm="annular", centre=centre, averaged=averaged)
    bound = small[1][f"doppler.bound.centre_{centre}.averaged_{averaged}.std"]
    error = (case["v"] - case["v_los"]).values.ravel()
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], error.size)
    # the rendered images have noise of their own
    own = small[1]["doppler.render.largest_error"]
    assert own < 0.05
    assert low * bound**2 < (error**2).sum() < high * (bound**2 + own**2)
    # of averages, it is seen as a misfit, by which stated errors grow
    np.testing.assert_allclose(case["v_std"], bound, rtol=0.15)


def test_the_paper_s_chain_has_its_bias_and_its_cure(found):
    """A Gaussian in r is off by -10 to -40 m/s; in r^2, by less than a few standard deviations of
    its scatter (0.3 m/s)."""
    error = found["v"] - found["v_los"]
    for name in ("ca", "ml", "sg"):
        one = error.sel(algorithm=name).values
        assert np.isfinite(one[..., 0]).all() and np.isnan(one[..., 1:]).all()
        assert (one[..., 0] < -10).all() and (one[..., 0] > -45).all()
    assert abs(error.sel(algorithm="ca_r2")).max() < 2.0
    bias = found["peak_bias"]
    assert (bias.sel(coordinate="r", piece=slice(0.3, 0.5)) < -10).all()
    assert (abs(bias.sel(coordinate="r2")) < 1.0).all()
    # the narrower the piece, the smaller the skew
    assert bias.sel(coordinate="r", piece=0.1) > bias.sel(coordinate="r", piece=0.3)


def test_both_fits_agree(found):
    """Sums over sectors lose little of what pixels know: the same noise moves both alike."""
    fits = [found["v"].sel(algorithm=name).isel(image=0) for name in ("annular", "pixels")]
    assert float(abs(fits[0] - fits[1]).max()) < 0.5 * float(found["v_std"].max())


def test_one_image_of_an_average_has_the_noise_of_a_sum():
    """Mean and variance of 2000 pixels, against sums of five images, within 5 sigma."""
    ccd = CCD(read_noise=3, dark_current="20 Hz")
    flat = torch.full((40, 50), 30.0)
    n, repeats = 5, 10
    singles = expose(flat, ccd, 1, range(n * repeats), modes=8.0, background=1.0)
    sums = singles.reshape(repeats, n, -1).sum(1).flatten()
    at_once = expose(n * flat, summed(ccd, n), 2, range(repeats), n * 8.0, n * 1.0).flatten()
    variance = n * (30 + 30**2 / 8 + 1 + 0.2 + 9 + 1 / 12)
    for got in (sums, at_once):
        assert abs(got.mean() - n * 31.2) < 5 * math.sqrt(variance / got.numel())
        assert abs(got.var() / variance - 1) < 5 * math.sqrt(2.2 / got.numel())


# ---------------------------------------------------------------- the folder


def test_folder_has_all_files(small):
    folder, metrics = small
    assert {path.name for path in folder.iterdir()} == FILES
    assert {path.stem for path in (folder / "figures").iterdir()} == FIGURES
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert all(math.isfinite(value) for value in metrics.values())


def test_metrics_are_the_stable_ones(small):
    measures = set(
        ("retrieved_fraction bias bias_lowest bias_highest bias_stderr std std_stderr").split()
    )
    cases = [f"centre_{c}.averaged_{n}" for c in ("free", "known") for n in (1, 9)]
    expected = {f"doppler.bound.{case}.std" for case in cases}
    for method in SMALL["doppler"]["retrieval"]["methods"]:
        more = {"expected_std", "expected_systematic"} if method in ("annular", "pixels") else set()
        # one image at a speed has no spread
        spread = {"bias_stderr", "std", "std_stderr"} if method != "annular" else set()
        expected |= {
            f"doppler.{method}.{c}.{name}" for c in cases for name in (measures | more) - spread
        }
    expected |= {
        f"doppler.{name}"
        for name in (
            "photons background_photons signal speckle_modes line_width free_spectral_range "
            "finesse velocity_range render.mc_relative_error render.largest_error "
            "reference.laser_drift reference.etalon_drift reference.bow_and_pupil "
            "reference.wedge_and_pupil reference.scrambling_needed"
        ).split()
    } | {f"timing.doppler_{name}_s" for name in ("render", "retrieve", "figures")}
    assert set(small[1]) == expected
    assert small[1]["doppler.photons"] == pytest.approx(2.4e7, rel=0.01)
    assert small[1]["doppler.background_photons"] < 1e-4 * small[1]["doppler.photons"]
    assert small[1]["doppler.velocity_range"] == pytest.approx(speed_of_light / 2 / 77248.5)


def test_report_contains_the_numbers(small):
    page = (small[0] / "report.html").read_text()
    metrics = small[1]
    for n in (1, 9):
        key = f"doppler.annular.centre_free.averaged_{n}.std"
        assert with_error(metrics[key], metrics[f"{key}_stderr"]) in page
        assert f"{metrics[f'doppler.bound.centre_free.averaged_{n}.std']:.3f}" in page
    assert page.count("data:image/webp;base64,") == len(FIGURES)
    assert "backscatter lidar" not in page and "Savitzky-Golay" in page


def written(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*.exr")}


def without_times(metrics):
    return {key: value for key, value in metrics.items() if not key.startswith("timing.")}


@pytest.mark.slow
def test_a_stopped_run_resumes_with_its_images(tmp_path, quick):
    settings = check(**QUICK | {"v_los": [0, 20]})
    first = run(settings, tmp_path / "run").metrics
    before, last = written(tmp_path / "run"), "fringes_received_01.exr"
    whole = read_fringes(tmp_path / "run" / last)
    (tmp_path / "run" / last).unlink()
    (tmp_path / "run" / "metrics.json").unlink()
    again = run(settings, tmp_path / "run").metrics
    after = written(tmp_path / "run")
    assert {name for name in before if before[name] == after[name]} == set(before) - {last}
    xr.testing.assert_equal(read_fringes(tmp_path / "run" / last), whole)
    assert without_times(again) == without_times(first)
    assert "using 2 of 3 ring images" in (tmp_path / "run" / "log.txt").read_text()


def test_images_that_the_fit_refuses_are_counted_and_it_says_why(tmp_path, quick):
    retrieval = QUICK["retrieval"] | {"images": 2, "max_chi_square": 1}
    metrics = run(check(**QUICK | {"retrieval": retrieval}), tmp_path).metrics
    assert metrics["doppler.annular.centre_known.averaged_1.retrieved_fraction"] == 0
    said = (tmp_path / "log.txt").read_text()
    assert "warning: annular: no wind from 2 of 2 images; chi-square" in said
    assert "expected at most 1:" in said


@pytest.mark.slow
def test_another_experiment_is_refused_or_replaces(tmp_path, quick):
    run(check(**QUICK), tmp_path)
    other = check(**QUICK | {"v_los": [5]})
    before = written(tmp_path)
    with pytest.raises(InputError, match="holds a run of another experiment"):
        run(other, tmp_path)
    assert written(tmp_path) == before
    run(other, tmp_path, overwrite=True)
    assert all(time > before[name] for name, time in written(tmp_path).items())


def test_both_lidars_in_one_experiment(tmp_path, quick, monkeypatch):
    leave_out_figures(monkeypatch)
    both = config.check(
        {
            "name": "both",
            "wake": {
                "vortex_pair": {"width": "40 m", "height": "30 m", "separation": "15 m"},
                "spacing": "1 m",
            },
            "render": {"samples_per_beam": 2, "max_order": 1},
            "retrieval": {"methods": ["cc"]},
            "doppler": {**QUICK, "camera": CAMERA},
        },
        "both",
    )
    metrics = run(both, tmp_path).metrics
    assert {"wind.nc", "v_los.nc", "image_t1.exr", "fringes_emitted.exr"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert "backscatter.cc.valid_fraction" in metrics
    assert "doppler.annular.centre_known.averaged_1.bias" in metrics
    page = (tmp_path / "report.html").read_text()
    assert "A backscatter lidar scans" in page and "A Doppler lidar images" in page


# ---------------------------------------------------------------- input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v_los": [1000]}, "doppler.v_los: 1000 m/s is not allowed; expected less than 970 m/s"),
        ({"ccd": {"full_well": 100}}, "doppler.ccd: a pixel that holds 100 photoelectrons is not"),
        (
            {
                "ccd": {
                    "multiplication": "emccd",
                    "multiplication_gain": 300,
                    "register_well": "30e3",
                }
            },
            "doppler.ccd: a pixel that holds 100 photoelectrons is not",
        ),
        ({"ccd": {"bits": 8}}, "doppler.ccd: a pixel that holds 155 photoelectrons is not"),
        ({"camera": {"width": 100, "height": 80}}, "doppler.camera: 0 ring(s) at 0 m/s are not"),
        ({"camera": {"width": 300, "height": 240}}, "doppler.camera: 1 ring(s) at 0 m/s are not"),
        ({"etalon": {"coatings": [[1.5, "100 nm", 50]]}}, "a mirror that transmits"),
    ],
)
def test_impossible_settings_are_reported_before_anything_is_written(tmp_path, changes, message):
    with pytest.raises(InputError) as error:
        run(check(**QUICK | changes), tmp_path / "run")
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "x: expected wake, doppler or both"),
        ({"doppler": {}, "scan": {"range": "400 m"}}, "x: scan: not allowed without wake"),
        ({"doppler": {"v_los": [1, 1]}}, "x: doppler: v_los: 1.0 twice is not allowed"),
        ({"doppler": {"path_samples": 1}}, "x: doppler: path_samples: 1 is not allowed"),
        ({"doppler": {"speckle_modes": 0}}, "x: doppler.speckle_modes: 0 is not allowed"),
        (
            {"doppler": {"retrieval": {"images": 2}}},
            "x: doppler.retrieval: slow_images: 3 is not allowed; expected at most images = 2",
        ),
        (
            {"doppler": {"retrieval": {"methods": ["annular", "annular"]}}},
            "x: doppler.retrieval: methods: 'annular' twice is not allowed",
        ),
    ],
)
def test_a_fault_in_the_file_is_one_line(data, message):
    with pytest.raises(InputError) as error:
        config.check({"name": "a"} | data, "x")
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_the_record_is_the_experiment_again():
    """Sections of a lidar that is not there are not in it."""
    text = config.dump(check())
    assert "scan:" not in text and "wake:" not in text
    import yaml

    assert config.check(yaml.safe_load(text), "again") == check()


@dataclasses.dataclass
class Caught(Exception):
    loaded: Experiment


@pytest.mark.parametrize("wake", [False, True])
def test_the_variant_option_reaches_the_lidar(tmp_path, monkeypatch, wake):
    def caught(loaded, *_, **__):
        raise Caught(loaded)

    monkeypatch.setattr(experiment, "run", caught)
    path = tmp_path / "x.yaml"
    data = {"name": "x", "doppler": {}} | ({"wake": {"vortex_pair": {}}} if wake else {})
    path.write_text(json.dumps(data))
    with pytest.raises(Caught) as stop:
        run_command(str(path), variant="llvm_ad_mono")
    loaded = stop.value.loaded
    assert loaded.doppler.render.variant == "llvm_ad_mono"
    if wake:
        assert loaded.render.variant == "llvm_ad_mono"
