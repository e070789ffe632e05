"""Runs that are stopped, resumed and repeated.

Detects: half-written files, images that are rendered twice, results of another experiment taken for
this one's, a folder of someone else's overwritten, and runs that do not repeat."""

import numpy as np
import pytest
import xarray as xr
import yaml

from lidar_mi.errors import InputError
from lidar_mi.experiment.folder import records
from lidar_mi.experiment.folder.run_folder import IMAGES
from lidar_mi.experiment.run import run
from lidar_mi.experiment.truth import flows as truth_module
from lidar_mi.io.exr import read_scan
from lidar_mi.io.wake_file import read_wake
from tests.support.experiments import blob, check, replace_stages, small, write_wake


def leftovers(folder):
    """Temporary names: hidden or partial files."""
    return [p for p in folder.rglob("*") if p.name.startswith(".") or p.suffix == ".part"]


def images_of(folder):
    return [(folder / name).stat().st_mtime_ns for name in IMAGES]


def layers(folder):
    return [read_scan(folder / name).drop_attrs() for name in IMAGES]


def without_timing(metrics):
    return {key: value for key, value in metrics.items() if not key.startswith("timing.")}


@pytest.mark.slow
def test_the_wake_is_read_once(tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(
        truth_module, "read_wake", lambda *a, **k: read.append(a) or read_wake(*a, **k)
    )
    monkeypatch.setattr("lidar_mi.assessment.figures.backscatter.draw_all", lambda *_: [])
    data = small()
    data["wake"] = {"file": write_wake(tmp_path / "w.nc", blob(8, -4))}
    metrics = run(check(data), tmp_path / "run", beside=tmp_path).metrics
    assert len(read) == 1 and "texture_sweep.40_percent.rmse_v" in metrics


@pytest.mark.slow
def test_a_rerun_uses_the_images(tmp_path, quick):
    folder = tmp_path / "run"
    before = run(check(small()), folder).metrics
    stamps = images_of(folder)
    (folder / "wind.nc").unlink()
    after = run(check(small()), folder).metrics
    assert images_of(folder) == stamps
    assert "using 2 of 2 images" in (folder / "log.txt").read_text()
    assert (folder / "wind.nc").is_file()
    assert without_timing(after) == without_timing(before)


@pytest.mark.slow
def test_a_missing_image_is_rendered_again_and_identical(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    stamps, before = images_of(folder), layers(folder)
    (folder / IMAGES[1]).unlink()
    run(check(small()), folder)
    assert images_of(folder)[0] == stamps[0] and images_of(folder)[1] != stamps[1]
    for one, other in zip(before, layers(folder), strict=True):
        xr.testing.assert_identical(one, other)


@pytest.mark.slow
def test_another_experiment_is_kept_out(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    stamps = images_of(folder)
    other = small() | {"seed": 2}
    with pytest.raises(InputError, match="another experiment"):
        run(check(other), folder)
    assert images_of(folder) == stamps
    run(check(other), folder, overwrite=True)
    assert all(new != old for new, old in zip(images_of(folder), stamps, strict=True))
    assert yaml.safe_load((folder / "experiment.yaml").read_text())["experiment"]["seed"] == 2


@pytest.mark.slow
def test_images_of_another_version_are_not_used(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    record = yaml.safe_load((folder / "experiment.yaml").read_text())
    record["versions"]["mitsuba"] = "3.5.0"
    (folder / "experiment.yaml").write_text(yaml.safe_dump(record))
    stamps = images_of(folder)
    with pytest.raises(InputError, match=r"a run of mitsuba 3.5.0, this is 3.*; expected"):
        run(check(small()), folder)
    assert images_of(folder) == stamps
    run(check(small()), folder, overwrite=True)
    assert images_of(folder) != stamps
    record["versions"]["numpy"] = "1.0"  # which makes no images
    run(check(small()), folder)


@pytest.mark.slow
def test_a_changed_wake_file_is_another_experiment(tmp_path, quick):
    """Same name, other content: the old images must not be taken for it."""
    data = small()
    data["wake"] = {"file": write_wake(tmp_path / "w.nc", blob(8, -4)), "texture": {"rms": 0}}
    run(check(data), tmp_path / "run", beside=tmp_path)
    run(check(data), tmp_path / "run", beside=tmp_path)
    write_wake(tmp_path / "w.nc", blob(8, 4))
    with pytest.raises(InputError, match="another experiment"):
        run(check(data), tmp_path / "run", beside=tmp_path)


@pytest.mark.slow
def test_overwriting_leaves_nothing_of_the_old_run(tmp_path, quick):
    """Stopped right after it began, the folder must not show the old winds as its own."""
    folder = tmp_path / "run"
    run(check(small()), folder)

    def stop(text, fraction):
        if "rendering" in text:
            raise KeyboardInterrupt

    with pytest.raises(BaseException):  # noqa: B017 - Dr.Jit wraps what is raised inside
        run(check(small() | {"seed": 2}), folder, overwrite=True, notice=stop)
    assert not {"wind.nc", "metrics.json", "report.html"} & {p.name for p in folder.iterdir()}


@pytest.mark.parametrize("content", ["my_thesis.txt", "experiment.yaml"])
def test_a_folder_that_is_no_run_folder_is_refused(tmp_path, content):
    (tmp_path / content).write_text("name: mine\n")
    for overwrite in (False, True):
        with pytest.raises(InputError, match=r"run folder|not written by a run"):
            run(check(small()), tmp_path, overwrite=overwrite)
    assert [p.name for p in tmp_path.iterdir()] == [content]


def test_a_file_in_the_folders_place_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(InputError, match="no run folder"):
        run(check(small()), tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    "step",
    [
        pytest.param("reading the wake", marks=pytest.mark.slow),
        pytest.param("rendering scan 1", marks=pytest.mark.slow),
        pytest.param("rendering scan 2", marks=pytest.mark.slow),
        "retrieving winds",
    ],
)
def test_stopped_anywhere_it_resumes(tmp_path, quick, step):
    """An interrupt at any step leaves whole files only, and the next start ends as if nothing had
    happened."""
    folder = tmp_path / "run"

    def stop(text, fraction):
        if step in text:
            raise KeyboardInterrupt

    with pytest.raises(BaseException) as caught:
        run(check(small()), folder, notice=stop)
    causes, error = [], caught.value
    while error is not None:
        causes.append(type(error))
        error = error.__cause__ or error.__context__
    assert KeyboardInterrupt in causes
    done = [folder / name for name in IMAGES if (folder / name).is_file()]
    for path in done:
        read_scan(path)
    assert leftovers(folder) == [] and not (folder / "metrics.json").exists()
    stamps = [path.stat().st_mtime_ns for path in done]
    metrics = run(check(small()), folder).metrics
    assert [path.stat().st_mtime_ns for path in done] == stamps
    expected = {
        "reading the wake": 0,
        "rendering scan 1": 0,
        "rendering scan 2": 1,
        "retrieving winds": 2,
    }[step]
    assert len(done) == expected
    assert without_timing(metrics) == without_timing(
        run(check(small()), tmp_path / "whole").metrics
    )


@pytest.mark.slow
def test_the_seed_decides(tmp_path, quick):
    runs = {}
    for name, seed in (("one", 1), ("again", 1), ("other", 2)):
        metrics = run(check(small() | {"seed": seed}), tmp_path / name).metrics
        runs[name] = (without_timing(metrics), layers(tmp_path / name))
    assert runs["one"][0] == runs["again"][0]
    for same, again, other in zip(
        *(runs[name][1] for name in ("one", "again", "other")), strict=True
    ):
        xr.testing.assert_identical(same, again)
        # other texture and other photons
        assert not np.array_equal(same["S0"], other["S0"])
    assert runs["one"][0] != runs["other"][0]


@pytest.mark.slow
def test_a_failed_run_is_recorded_in_its_log(tmp_path, quick, monkeypatch):
    """And one that is stopped does not; see `test_stopped_anywhere_it_resumes`."""
    folder = tmp_path / "run"

    def broken(*_, log):
        raise InputError("wind: 7 is not allowed;\nexpected 8")

    with monkeypatch.context() as patch:
        replace_stages(patch, wind=broken)
        with pytest.raises(InputError):
            run(check(small()), folder)
    assert records.failure(folder) == "wind: 7 is not allowed; expected 8"
    run(check(small()), folder)
    assert records.failure(folder) is None
