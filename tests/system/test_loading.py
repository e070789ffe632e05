"""What the commands load. System tier.

Detects a library that a command does not need: each takes a fifth of a second to several seconds of
every call.
"""

import json

import numpy as np
import OpenEXR
import pytest

from tests.support.loaded import modules_of_command

COMPUTING = set(
    (
        "torch kornia mitsuba drjit matplotlib jsbsim distributed loky scipy.stats scipy.signal "
        "lidar_mi.plugins"
    ).split()
)
"""Loaded by what is rendered, retrieved, drawn, flown or run on workers."""
READING = set(
    (
        "xarray pandas dask h5py h5netcdf pint scipy.interpolate scipy.ndimage scipy.optimize "
        "scipy.spatial jinja2"
    ).split()
)
"""Loaded by wakes, by the air's motion and by units that are rare."""
DESCRIBING = {"numpy", "scipy"}
"""Loaded by an experiment file."""


@pytest.mark.parametrize("arguments", [("--help",), ("run", "--help"), ("check", "--help")])
def test_help(arguments):
    found = modules_of_command(*arguments) & (COMPUTING | READING | DESCRIBING)
    assert not found


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "run", "fly"])
@pytest.mark.parametrize("text", ["wakes: {}", "wake: {vortex_pair: {circulation: 1e9}}"])
def test_a_fault_of_an_experiment_file(tmp_path, command, text):
    (tmp_path / "a.yaml").write_text(f"name: a\n{text}\n")
    loaded = modules_of_command(command, "a.yaml", cwd=tmp_path)
    assert not loaded & (COMPUTING | READING) and "pydantic" in loaded


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["wake_backscatter", "wake_sensor", "fringes_paper", "airport", "encounter"]
)
def test_check(name):
    loaded = modules_of_command("check", name)
    assert not loaded & (COMPUTING | {"lidar_mi.experiment.preflight.cost"})
    # by what the experiment has
    assert ("lidar_mi.encounter.check" in loaded) == (name == "encounter")
    assert ("h5py" in loaded) == name.startswith("wake")


def test_list():
    """The files' first lines alone, and YAML for what is flown."""
    assert not modules_of_command("list") & (COMPUTING | READING | DESCRIBING)


# a wavelength is shown in nm by pint, which loads what it finds of two others
@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "rare"),
    [
        (("explain", "scan.gates"), set()),
        (("explain", "lidar"), {"pint", "dask", "jinja2"}),
        (("explain", "scan.gate"), set()),
        (("new", "mine"), set()),
    ],
)
def test_keys(tmp_path, arguments, rare):
    loaded = modules_of_command(*arguments, cwd=tmp_path)
    assert not loaded & (COMPUTING | READING - rare) and "pydantic" in loaded


@pytest.mark.parametrize("what", ["spheroids", "molecules"])
def test_info_of_a_scatterer(what):
    loaded = modules_of_command("info", what)
    # the standard atmosphere is a library with libraries of its own
    allowed = {"scipy.optimize", "scipy.spatial"} if what == "molecules" else set()
    assert not loaded & (COMPUTING | READING - allowed)


def test_info_of_an_image(tmp_path):
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.ones((2, 3), np.float32)}).write(
        str(tmp_path / "a.exr")
    )
    assert not modules_of_command("info", tmp_path / "a.exr") & (COMPUTING | READING)


def test_info_of_a_run_folder(tmp_path):
    (tmp_path / "experiment.yaml").write_text("experiment: {name: a, seed: 3}\nversions: {}\n")
    (tmp_path / "metrics.json").write_text(json.dumps({"backscatter.mc_relative_error": 0.1}))
    assert not modules_of_command("info", tmp_path) & (COMPUTING | READING)


@pytest.mark.slow
@pytest.mark.parametrize(("command", "name"), [("run", "wake_sensor"), ("fly", "encounter")])
def test_what_is_loaded_before_a_run_says_that_it_starts(tmp_path, command, name):
    """The first line of progress comes as soon as the experiment file is read."""
    stop = (
        "from contextlib import contextmanager\n"
        f"from lidar_mi.cli import {command} as command\n"
        "@contextmanager\n"
        "def progress():\n"
        "    def notice(text, fraction):\n"
        f"        raise SystemExit if text == 'starting {name}' else AssertionError(text)\n"
        "    yield notice\n"
        "command.progress = progress"
    )
    loaded = modules_of_command(command, name, "-o", tmp_path / "a", before=stop)
    assert not loaded & (COMPUTING | READING) and "pydantic" in loaded
