"""One run of the demo, shared by every test that looks at its results."""

from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import pytest

from lidar_mi.experiment import reading as config
from lidar_mi.experiment import run as experiment

SCENES = Path(str(files("lidar_mi.scenes")))


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """What ``lidar-mi run wake_backscatter`` leaves: folder, metrics, and what it told."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    loaded = config.load(SCENES / "wake_backscatter.yaml")
    told = []
    metrics = experiment.run(
        loaded, folder, SCENES, notice=lambda text, share: told.append((text, share))
    )
    return SimpleNamespace(folder=folder, experiment=loaded, metrics=metrics, told=told)
