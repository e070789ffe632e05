"""One run of the demo for every test that looks at its results, quick runs, the command line."""

import gc
import os
import pickle
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock

from lidar_mi.experiment import run as experiment
from lidar_mi.schema import reading as config
from tests.support.command_line import TINY, in_process
from tests.support.experiments import sketched_figures, whole_figures, without_figures

SCENES = Path(str(files("lidar_mi.scenes")))


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """What ``lidar-mi run wake_backscatter`` leaves: folder, metrics, and what it told.

    One run for all processes of pytest-xdist.
    """
    here = tmp_path_factory.getbasetemp()
    shared = (here.parent if "PYTEST_XDIST_WORKER" in os.environ else here) / "demo"
    loaded = config.load(SCENES / "wake_backscatter.yaml")
    left = shared / "left.pickle"
    with FileLock(f"{shared}.lock"):
        if not left.is_file():
            reported = []
            with whole_figures():  # a module's sketches may have begun
                done = experiment.run(
                    loaded,
                    shared / "run",
                    beside=SCENES,
                    notice=lambda text, fraction: reported.append((text, fraction)),
                )
            left.write_bytes(pickle.dumps((done.metrics, reported)))
    metrics, reported = pickle.loads(left.read_bytes())
    return SimpleNamespace(
        folder=shared / "run", experiment=loaded, metrics=metrics, reported=reported
    )


@pytest.fixture(scope="module", autouse=True)
def free_scenes():
    """Scenes hold reference cycles, and every live one takes part in later kernels."""
    yield
    gc.collect()
    gc.collect()


@pytest.fixture(scope="module", autouse=True)
def sketches():
    """The demo apart, figures are drawn to be there."""
    with sketched_figures():
        yield


@pytest.fixture
def quick():
    with without_figures():
        yield


@pytest.fixture
def there(tmp_path, monkeypatch):
    """A folder to work in, with an experiment and a small scene; names stay short in messages."""
    (tmp_path / "tiny.yaml").write_text(TINY)
    scene = (SCENES / "slab.xml").read_text()
    scene = scene.replace('value="219"', 'value="21"').replace('value="139"', 'value="17"')
    (tmp_path / "slab.xml").write_text(scene)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def lidar_mi():
    """Runs the command in this process: exit code, output, error output."""

    def call(*arguments):
        done = in_process(*arguments)
        return done.returncode, done.stdout, done.stderr

    return call
