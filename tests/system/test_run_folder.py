"""Whose a run folder is: one process at a time, and nothing in it that something else made.

Detects two runs that mix their images, a lock that outlives its process, and images or metrics of
another experiment that are taken for this one's.
"""

import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.records import read_metrics
from lidar_mi.experiment.folder.run_folder import MADE_BY, RunFolder
from lidar_mi.experiment.run import run
from lidar_mi.io.exr import read_scan
from lidar_mi.io.folder import locked
from lidar_mi.io.json import read_json
from lidar_mi.io.netcdf import read_netcdf
from lidar_mi.io.vortex_file import read_vortices
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from tests.support.experiments import blob, check, small, write_wake


@contextmanager
def another_process(folder):
    """Hold a folder in another process until the context ends or the process is killed."""
    code = (
        "import sys; from lidar_mi.io.folder import locked\n"
        f"with locked({str(folder)!r}):\n    print('held', flush=True)\n    sys.stdin.read()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as process:
        assert process.stdout.readline() == b"held\n"
        yield process
        process.stdin.close()


def test_a_second_run_is_refused_while_the_first_works(tmp_path, quick):
    """The second has another seed; it comes when the first renders, and changes nothing."""
    folder, refused = tmp_path / "run", []

    def notice(text, fraction):
        if "rendering scan 2" in text and not refused:
            for overwrite in (False, True):
                with pytest.raises(InputError, match="in use by another run") as caught:
                    run(check(small() | {"seed": 2}), folder, overwrite=overwrite)
                refused.append(caught.value)

    done = run(check(small()), folder, notice=notice)
    assert len(refused) == 2
    assert done.metrics == read_metrics(folder)
    assert read_scan(folder / "image_t2.exr").attrs["seed"] == 1
    assert not list(folder.glob(".*"))


def test_the_lock_dies_with_its_process(tmp_path):
    with another_process(tmp_path) as process:
        with pytest.raises(InputError, match="in use"), locked(tmp_path):
            pytest.fail("held twice")
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert (tmp_path / ".lock").exists()  # what is left of it does not matter
        with locked(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_a_study_is_refused_in_a_folder_at_work(there, lidar_mi):
    text = (there / "tiny.yaml").read_text() + "variants: {a: {seed: 1}, b: {seed: 2}}\n"
    (there / "two.yaml").write_text(text)
    (there / "out").mkdir()
    with locked(there / "out"):
        code, _, err = lidar_mi("run", "two.yaml", "-o", "out")
    assert code == 2 and "out: is in use by another run" in err
    assert not list((there / "out").iterdir())


@pytest.mark.slow
def test_a_damaged_image_is_rendered_again(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    image = folder / "image_t1.exr"
    before = read_scan(image)
    image.write_bytes(image.read_bytes()[:-1000])
    run(check(small()), folder)
    assert (read_scan(image)["S0"] == before["S0"]).all()


@pytest.mark.slow
def test_results_identify_their_run(tmp_path, quick):
    hashes = {}
    for name, seed in (("one", 1), ("again", 1), ("other", 2)):
        folder = tmp_path / name
        run(check(small() | {"seed": seed}), folder)
        image, wind = read_scan(folder / "image_t1.exr"), read_netcdf(folder / "wind.nc")
        assert image.attrs[MADE_BY] == wind.attrs[MADE_BY]
        hashes[name] = wind.attrs[MADE_BY]
    assert hashes["one"] == hashes["again"] != hashes["other"]


@pytest.mark.slow
def test_metrics_of_another_run_are_not_shown(tmp_path, quick, lidar_mi):
    folder, other = tmp_path / "run", tmp_path / "other"
    run(check(small()), folder)
    run(check(small() | {"seed": 2}), other)
    assert lidar_mi("info", folder)[0] == 0
    shutil.copy(other / "metrics.json", folder)
    code, _, err = lidar_mi("info", folder)
    assert code == 2 and "metrics.json: was changed or copied here" in err


def test_results_without_images_are_not_replaced_by_default(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    for image in folder.glob("*.exr"):
        image.unlink()
    with pytest.raises(InputError, match="holds a run of another experiment"):
        run(check(small() | {"seed": 2}), folder)
    assert (folder / "wind.nc").is_file()


def test_vortices_identify_their_run(tmp_path):
    """They are written as JSON, which has no attributes."""
    folder = RunFolder(tmp_path, check(small()), tmp_path)
    parameters = np.array([300.0, 1.0, 15.0, 0.0, -300.0, 1.0, -15.0, 0.0, 0.0, 0.0])
    fit = VortexPairFit(parameters, np.eye(10), "lamb_oseen", 1.0, 1.0, 0.0, 0.0)
    folder.store_result("vortices", SimpleNamespace(pairs={"mine": fit}, method="variational"))
    written = read_json(tmp_path / "vortex.json", "vortices")
    assert written[MADE_BY] == folder.made_by and written["vectors_method"] == "variational"
    assert read_vortices(tmp_path / "vortex.json")["mine"].port.circulation == 300
    folder.store_result("vortices", None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["wind.nc", "image_t1.exr", "metrics.json"])
def test_a_wake_file_is_never_written_over(tmp_path, name):
    """Not even with ``overwrite``, in the folder of an earlier run."""
    with RunFolder(tmp_path / "run", check(small()), tmp_path).claimed(overwrite=False):
        pass
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    wake = tmp_path / "run" / name
    write_wake(wake, blob(8, -4))
    before[wake] = wake.read_bytes()
    data = small()
    data["wake"] = {"file": f"run/{name}"}
    again = RunFolder(tmp_path / "run", check(data), tmp_path)
    with (
        pytest.raises(InputError, match=rf"wake.file: .*{name} lies where this run writes"),
        again.claimed(overwrite=True),
    ):
        pytest.fail("claimed")
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
