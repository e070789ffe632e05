"""Variants of one experiment: read, run, compared.

Detects changes that reach another variant or are lost, faults that do not name the variant and key,
a comparison that leaves a variant out or sets the wrong number beside it, and shipped
experiments that cannot be read or do not fit together.
"""

import json
import re
from importlib.resources import files
from pathlib import Path

import pytest
import xarray as xr
import yaml
from matplotlib.image import imread

from lidar_mi.assessment.digits import three
from lidar_mi.assessment.figures import comparison as figures
from lidar_mi.assessment.report import comparison
from lidar_mi.assessment.report.comparison import differences, flat
from lidar_mi.encounter.check import geometry
from lidar_mi.errors import InputError
from lidar_mi.experiment import run as experiment
from lidar_mi.experiment import study
from lidar_mi.experiment.describe import sections
from lidar_mi.schema import reading as config
from tests.support.experiments import leave_out_figures

SCENES = Path(str(files("lidar_mi.scenes"))).resolve()
PAIR = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
SMALL = {
    "name": "two",
    "wake": {"vortex_pair": PAIR, "spacing": 1},
    "lidar": {"pulse_duration": "10 ns"},
    "render": {"samples_per_beam": 4, "max_order": 1},
    "retrieval": {"methods": ["cc"]},
    "variants": {
        "near": {"scan": {"range": "150 m"}, "lidar": {"fov_half": "6 mrad"}},
        "far": {"scan": {"range": "500 m"}, "detector": {}},
    },
}


@pytest.fixture
def file(tmp_path):
    """Writes an experiment file with some top-level keys replaced."""

    def write(**changes):
        path = tmp_path / "two.yaml"
        path.write_text(yaml.safe_dump(SMALL | changes, sort_keys=False))
        return path

    return write


def test_each_variant_changes_its_own_keys(file):
    found = config.load_variants(file())
    near, far = found["near"], found["far"]
    assert list(found) == ["near", "far"] and near.name == "two.near"
    assert (near.scan.range, far.scan.range) == (150, 500)
    assert near.lidar.fov_half == pytest.approx(6e-3) and far.lidar.fov_half == pytest.approx(5e-3)
    assert near.lidar.pulse_duration == 1e-8 == far.lidar.pulse_duration
    assert near.detector is None and far.detector is not None


def test_null_takes_a_section_away(file):
    path = file(detector={}, variants={"dark": {"detector": None}, "lit": {}})
    found = config.load_variants(path)
    assert found["dark"].detector is None and found["lit"].detector is not None
    # one that every experiment has is back at its defaults
    found = config.load_variants(file(variants={"plain": {"retrieval": None}}))
    assert found["plain"].retrieval.methods != ("cc",) and SMALL["retrieval"] == {"methods": ["cc"]}


def test_overrides_count_for_all_or_for_one(file):
    sets = ["seed=7", "scan.range=300 m", "variants.near.scan.thickness=1 m"]
    found = config.load_variants(file(), sets)
    assert {one.seed for one in found.values()} == {7}
    assert [one.scan.range for one in found.values()] == [300, 300]
    assert [one.scan.thickness for one in found.values()] == [1, 2.5]


def test_plain_files_have_none(file):
    assert config.load_variants(SCENES / "wake_backscatter.yaml") == {}
    with pytest.raises(InputError, match="variants: not allowed for a single experiment"):
        config.load(file())


@pytest.mark.parametrize(
    ("variants", "message"),
    [
        ({}, "variants: {} is not allowed"),
        ([1], "variants: [1] is not allowed"),
        ({"near": 3}, "variants.near: 3 is not allowed; expected keys to change"),
        ({"a/b": {}}, "variants.a/b: not allowed; expected a name of at most 100 letters"),
        ({"near": {"name": "x"}}, "variants.near.name: not allowed"),
        (
            {"near": {"scan": {"rnage": 1}}},
            "variants.near: scan.rnage: unknown key; did you mean range?",
        ),
        ({"near": {"seed": -1}}, "variants.near: seed: -1"),
    ],
)
def test_faults_name_the_variant(file, variants, message):
    with pytest.raises(InputError) as error:
        config.load_variants(file(variants=variants))
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.usefixtures("variant")
def test_all_run_and_are_compared(file, tmp_path, monkeypatch):
    leave_out_figures(monkeypatch)
    folder, reported = tmp_path / "out", []
    variants = config.load_variants(file())
    found = study.run("two", variants, folder, notice=lambda text, _: reported.append(text))
    assert {text.split(":")[0] for text in reported} >= {"near", "far"}
    merged = json.loads((folder / "metrics.json").read_text())
    for name in variants:
        alone = json.loads((folder / name / "metrics.json").read_text())
        assert alone == found[name]
        assert {key: merged[f"{name}.{key}"] for key in alone} == alone
        assert (folder / name / "report.html").is_file()
    page = (folder / "report.html").read_text()
    assert '<a href="near/report.html">' in page and '<a href="far/report.html">' in page
    cells = dict(
        re.findall(
            r"<tr><td>([^<]+)</td>(?:<td[^>]*>[^<]*</td>)?<td[^>]*>([^<]+)</td><td[^>]*>[^<]+</td></tr>",
            page,
        )
    )
    assert cells["scan.range"] == "150 m"
    assert float(cells["hazard distance of a beam, unaided"]) == pytest.approx(
        found["near"]["safety.hazard_distance"], rel=5e-3
    )
    assert imread(folder / "figures" / "fig00_comparison.png").std() > 0.05
    reported = {title: rows for title, rows in sections(str(folder))}
    rows = {name: values for name, *values in next(iter(reported.values()))}
    assert f"{folder}: study two" in reported and rows["variant"] == ["near", "far"]
    assert rows["scan.range"] == ["150 m", "500 m"]
    results = {name: values for name, *values in reported["results"]}
    assert float(results["hazard distance of a beam, unaided / m"][0]) == pytest.approx(
        found["near"]["safety.hazard_distance"], rel=5e-3
    )
    names = [name for name, _ in reported["files"]]
    assert "report.html" in names and "near/report.html" not in names
    # again: nothing is rendered; other things are not overwritten
    before = (folder / "near" / "image_t1.exr").stat().st_mtime_ns
    study.run("two", variants, folder)
    assert (folder / "near" / "image_t1.exr").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="is no study's folder"):
        study.run("two", variants, tmp_path)


VOLUME = {
    "wake": {
        "file": "wake_volume_40s.nc",
        "vortex_pair": None,
        "time": "40 s",
        "depth": "volume",
        "x": "20 m",
        "spacing": "1 m",
    },
    "scan": {"range": "495 m", "thickness": "10 m", "gate_count": 10},
    "render": {"samples_per_beam": 60, "max_order": 1},
    "retrieval": None,
    "volume": {"methods": ["correlation"], "stride": 4},
}


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_volumes_are_compared(file, tmp_path, monkeypatch):
    """Their wind is another file with a layer more: drawn is the one nearest to the image."""
    monkeypatch.setattr("lidar_mi.assessment.figures.volume.draw_all", lambda *_: [])
    drawn, draw = {}, figures.draw_comparison
    monkeypatch.setattr(
        figures,
        "draw_comparison",
        lambda folder, rows, log: drawn.update(rows) or draw(folder, rows, log),
    )
    metrics = study.run(
        "two", config.load_variants(file(variants={"volume": VOLUME})), tmp_path / "out"
    )
    assert imread(tmp_path / "out" / "figures" / "fig00_comparison.png").std() > 0.05
    with xr.open_dataset(tmp_path / "out/volume/wind_volume.nc", engine="h5netcdf") as found:
        nearest = found.isel(source=0, algorithm=0).sel(x=495.0, method="nearest")
        rendered, wind, _ = drawn["volume"]
        assert rendered.dims == wind["w"].dims == ("z", "y")
        assert float(wind["x"]) == float(nearest["x"]) and wind["w_true"].equals(nearest["w_true"])
    table = {name: values for name, _, values in comparison.results(metrics)}
    u = metrics["volume"]["backscatter.correlation.outside_cores.rmse_u"]
    (shown,) = table["correlation: rms error of u beyond two core radii"]
    assert float(shown) == pytest.approx(u, abs=6e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_doppler_lidars_alone_are_compared(tmp_path, monkeypatch):
    """The paper's two ranges, whose photons it gives: 2.4e7 from 56 m, 1.3e7 from 76 m."""
    data = {
        "name": "rings",
        "doppler": {
            "camera": {"pixel": "29.6 um", "width": 240, "height": 195},
            "v_los": [0.0],
            "path_samples": 0,
            "ccd": {"full_well": 1e8, "bits": None},
            # with 16 the simulation's noise is beyond that of 2.4e7 photons: chi-square refuses
            "render": {"samples_per_pixel": 64},
            "retrieval": {"methods": ["annular"], "averaged": [1], "images": 3, "slow_images": 0},
        },
        "variants": {
            "near": {"doppler": {"lidar": {"range": "56 m"}}},
            "far": {"doppler": {"lidar": {"range": "76 m"}}},
        },
    }
    monkeypatch.setattr("lidar_mi.assessment.figures.doppler.draw_all", lambda *_: [])
    path = tmp_path / "rings.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    metrics = study.run("rings", config.load_variants(path), tmp_path / "out")
    assert not (tmp_path / "out" / "figures").exists()
    table = {name: values for name, _, values in comparison.results(metrics)}
    assert table["Doppler lidar: photons of a pulse"] == [
        three(one["doppler.photons"]) for one in metrics.values()
    ]
    photons = [one["doppler.photons"] for one in metrics.values()]
    assert photons == pytest.approx([2.4e7, 1.3e7], rel=0.03)
    name = "one pulse by all rings, full model, centre known: standard deviation"
    spread = [one["doppler.annular.centre_known.averaged_1.std"] for one in metrics.values()]
    assert [float(text) for text in table[name]] == pytest.approx(spread, abs=6e-4)
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"<td>{name}</td>" in page and '<a href="near/report.html">' in page


def test_info_on_a_study_that_was_stopped(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "study.yaml").write_text("{name: two, variants: [near, far]}")
    title, rows = next(sections(str(folder)))
    assert title == f"{folder}: study two" and rows == [
        ("variant", "near (not run)", "far (not run)")
    ]
    (folder / "study.yaml").write_text("[1]")
    with pytest.raises(InputError, match=r"study.yaml: not written by a study"):
        list(sections(str(folder)))


def test_a_fault_in_the_last_stops_the_first(file, tmp_path):
    """What a chain finds out ahead is reported before anything is written."""
    variants = SMALL["variants"] | {"bad": {"retrieval": {"template": 60, "search": 70}}}
    with pytest.raises(InputError):
        study.run("two", config.load_variants(file(variants=variants)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_differences_of_settings():
    one, other = (
        {"a": {"b": 1, "c": [1]}, "name": "x"},
        {"a": {"b": 2, "c": [1]}, "d": 3, "name": "y"},
    )
    assert differences({"x": flat(one), "y": flat(other)}) == {"a.b": [1, 2], "d": [None, 3]}


# --- what ships ---------------------------------------------------------------------------------


def shipped():
    """Every shipped experiment, and every variant of one, on a coarser grid."""
    for path in sorted(SCENES.glob("*.yaml")):
        coarse = ["wake.spacing=1 m"] if "wake" in yaml.safe_load(path.read_text()) else []
        variants = config.load_variants(path, coarse)
        yield from ((one.name, one) for one in variants.values() or [config.load(path, coarse)])


def test_shipped_experiments_are_documented():
    """Each has a page that says what it finds, and so has each campaign."""
    pages = {page.stem for page in (SCENES.parent / "docs" / "experiments").glob("*.md")}
    shipped = {path.stem for path in SCENES.rglob("*.yaml")}
    assert pages - {"index"} <= shipped
    assert {path.stem for path in (SCENES / "campaigns").glob("*.yaml")} <= pages


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("name", "one"),
    [
        # carrying air on in three dimensions and reading a series of states take 4 to 30 s
        pytest.param(
            name,
            one,
            marks=[pytest.mark.slow]
            * (name in ("wake_3d", "turbine", "real_wakes", "wake_changing")),
            id=name,
        )
        for name, one in shipped()
    ],
)
def test_shipped_experiments_fit_together(name, one):
    """Everything that a run or a flight checks before it writes: files, tables, lines within the
    wake, a path that meets it."""
    if one.encounter:
        assert geometry(one) == []
    else:
        experiment.prepare(one, SCENES)


# what makes a shipped experiment small; what it is about stays
SMALLER = (
    "wake.spacing=1 m",
    "render.samples_per_beam=8",
    "render.max_order=1",
    "retrieval.methods=[cc]",
    "retrieval.stride=4",
    "seed=2",
)
SMALLER_SENSOR = (
    "sensor.method=cc",
    "sensor.crossflow_std=0.5 m/s",
    "sensor.pulses=5",
    "doppler.ccd.full_well=1e6",
    "doppler.camera={pixel: 29.6 um, width: 240, height: 195}",
    "doppler.render.samples_per_pixel=16",
    "doppler.retrieval={methods: [annular], averaged: [1], images: 2, slow_images: 0}",
)


def small_run(name, folder, more=()):
    path = SCENES / f"{name}.yaml"
    sets = [*SMALLER, *more]
    with pytest.MonkeyPatch.context() as patch:
        leave_out_figures(patch)
        variants = config.load_variants(path, sets)
        if variants:
            return study.run(name, variants, folder, SCENES)
        return experiment.run(config.load(path, sets), folder, beside=SCENES).metrics


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_turbine_is_observed_by_both(tmp_path):
    """The mean wake's deficit of 4 m/s from lines of sight 11 m apart, to 0.5 m/s rms.

    Without gusts, which lines step over; and no look-ahead time of a platform that stands, nor a
    verdict on what flight control asks for.
    """
    metrics = small_run("turbine", tmp_path / "run", [*SMALLER_SENSOR, "wake.turbine.turbulence=0"])
    assert metrics["sensor.lines_retrieved"] == 63
    assert metrics["sensor.rmse_u"] < 0.5 < metrics["sensor.triples.rmse_u"]
    report = (tmp_path / "run" / "report.html").read_text()
    assert "The platform is at rest: there is no look-ahead time" in report
    assert "flight control do not apply" in report and "the look-ahead time is" not in report
    assert 'id="verdict-1"' not in report and "fulfilled" not in report
    assert not [key for key in metrics if key.endswith(".margin")]


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_infrared_and_ultraviolet_may_be_strong(tmp_path):
    """At what eyes may look into from 10 m on, green light is lost in its noise, others are not."""
    found = small_run("eye_safe", tmp_path / "run")
    for one in found.values():
        assert one["safety.scan_hazard_distance"] < 10.5
    noise = {name: one["detector.noise.all"] for name, one in found.items()}
    assert max(noise["nm355"], noise["nm1550"]) < 0.2 < noise["nm532"]
