"""Commands below folders of any name, in terminals of any encoding. Detects a name that is taken
for markup, an option, a pattern, a home or an address, or that a library cannot open: every command
works, or says in one line that it cannot before it has computed anything."""

import io
import os
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from lidar_mi.cli.app import main
from lidar_mi.errors import InputError
from lidar_mi.io.json import read_json
from lidar_mi.io.text import read_text
from lidar_mi.io.timed_table import read_timed_table
from lidar_mi.io.yaml import read_yaml, to_yaml
from lidar_mi.progress import Terminal
from tests.support.campaigns import described
from tests.support.command_line import TINY, shell

NAMES = {
    "blanks": b" my  runs ",
    "quotes": b'o\'brien "x"',
    "unicode": "Börse 日本".encode(),
    "latin1": b"B\xf6rse",
    "newline": b"two\nlines",
    "dash": b"-o",
    "percent": b"100%d %s {x}",
    "dollar": b"$HOME $x",
    "hash": b"#a;b&c|d",
    "brackets": b"a[1]*?",
    "tilde": b"~",
    "colon": b"http:a:b",
    "backslash": b"a\\nb\\",
    "escape": b"\x1b[31m",
    "long": b"n" * 250,
}


@pytest.fixture
def command(monkeypatch, tmp_path):
    """A command in this process below a folder of some name: exit code, output, errors."""

    def below(name):
        folder = os.path.join(os.fsencode(tmp_path), NAMES[name])
        os.makedirs(folder)
        monkeypatch.chdir(os.fsdecode(folder))
        return Path(os.fsdecode(folder))

    def call(*arguments):
        streams = [io.TextIOWrapper(io.BytesIO(), "utf-8") for _ in range(2)]
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["lidar-mi", *map(str, arguments)])
            patch.setattr(sys, "stdout", streams[0])
            patch.setattr(sys, "stderr", streams[1])
            with pytest.raises(SystemExit) as ended:
                main()
        for stream in streams:
            stream.flush()
        said = [stream.buffer.getvalue().decode() for stream in streams]
        return ended.value.code, *said

    return below, call


def fill(folder):
    """A small wake and an experiment of it with a scattering table of its own, a scene."""
    y, z = np.arange(-15.0, 16), np.arange(-12.0, 13)
    wind = 3 * np.sin(np.hypot(y, z[:, None]) / 5)
    data = {n: (("z", "y"), wind, {"units": "m/s"}) for n in "vw"}
    data["tracer"] = ("z", "y"), np.exp(-(np.hypot(y, z[:, None]) ** 2) / 20), {"units": "1"}
    axes = {"y": ("y", y, {"units": "m"}), "z": ("z", z, {"units": "m"})}
    content = xr.Dataset(data, axes).to_netcdf(engine="h5netcdf")
    (folder / "wake.nc").write_bytes(content)
    scenes = Path(str(files("lidar_mi.scenes")))
    shutil.copy(scenes / "aerosol_dust_532nm.txt", folder / "dust.txt")
    shutil.copy(scenes / "slab.xml", folder)
    (folder / "small.yaml").write_text(
        "name: small\n"
        "wake: {file: wake.nc, spacing: 1 m, extinction: {aerosol: null}}\n"
        "scattering: {phase: table, table: dust.txt}\n"
        "render: {samples_per_beam: 2, max_order: 1}\n"
        "retrieval: {methods: [cc], stride: 4}\n"
    )


def succeeds(call, *arguments):
    code, out, err = call(*arguments)
    # images of noise have no valid vector
    assert code == 0 or (code == 1 and "no valid vector" in err), (arguments, err)
    return out


QUICK = ("blanks", "latin1", "newline", "dash", "dollar", "brackets", "long")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_commands_below_folders_of_any_name(command, name):
    below, call = command
    folder = below(name)
    fill(folder)
    assert "it can be run; 2 warnings" in succeeds(call, "check", folder / "small.yaml")
    succeeds(call, "info", folder / "wake.nc")
    succeeds(call, "info", "./dust.txt")
    succeeds(call, "aerosol", "sea_salt", "--nodes", "4", "-o", folder / "salt.txt")
    succeeds(call, "info", folder / "salt.txt")
    scene = folder / "slab.xml"
    if name == "latin1":
        code, _, err = call("render", scene, "-s", "2", "-o", folder / "slab.exr")
        assert code == 2 and "a name that is not UTF-8 is not allowed for a scene" in err
        shutil.copy(scene, folder.parent / "slab.xml")
        scene = folder.parent / "slab.xml"
    succeeds(call, "render", scene, "-s", "2", "-o", folder / "slab.exr")
    succeeds(call, "info", folder / "slab.exr")
    air = 100 + 50 * np.random.default_rng(1).random((48, 49))
    for image, start in (("a.png", 0), ("b.png", 1)):
        Image.fromarray(air[:, start : start + 48].astype("u1")).save(folder / image)
    pair = (folder / "a.png", folder / "b.png", "--spacing", "0.5", "--dt", "0.1")
    method = ("--method", "cc", "--stride", "8", "-o", folder / "wind.nc")
    succeeds(call, "retrieve", *pair, *method)
    succeeds(call, "info", folder / "wind.nc")
    code, _, err = call("rings", folder / "slab.png")
    assert code == 2 and err.startswith("lidar-mi: ") and err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["latin1", "newline", "dash", "dollar", "brackets"])
def test_runs_and_flights_below_folders_of_any_name(command, name):
    below, call = command
    folder = below(name)
    fill(folder)
    run = folder / "out"
    succeeds(call, "run", "small.yaml", "-o", run)
    assert (run / "report.html").is_file()
    # an unchanged run is found again
    times = {path: path.stat().st_mtime_ns for path in run.glob("*.exr")}
    succeeds(call, "run", folder / "small.yaml", "-o", run)
    assert times == {path: path.stat().st_mtime_ns for path in run.glob("*.exr")}
    succeeds(call, "info", run)
    for form in ("vtk", "csv", "mat"):
        succeeds(call, "export", run, "--format", form)
    short = ("encounter.path.start=60 m", "encounter.path.beyond=10 m")
    sets = [part for one in short for part in ("--set", one)]
    succeeds(call, "fly", "encounter", "--mode", "off", *sets, "-o", folder / "flight")
    succeeds(call, "info", folder / "flight")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["latin1", "dollar", "newline", "dash"])
def test_campaigns_below_folders_of_any_name(tmp_path, name):
    """In processes of their own: workers are started below the folder, too."""
    folder = Path(os.fsdecode(os.path.join(os.fsencode(tmp_path), NAMES[name])))
    folder.mkdir()
    path = described(folder, sweep={"retrieval.template": [6, 8]})
    for arguments in (
        ("campaign", "run", path, "-o", folder / "all", "--workers", "1"),
        ("campaign", "status", folder / "all"),
        ("campaign", "report", folder / "all"),
        ("info", folder / "all"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "lidar_mi.cli.app", *map(os.fsencode, arguments)],
            capture_output=True,
            cwd=folder,
            check=False,
        )
        assert done.returncode == 0, done.stderr.decode(errors="replace")


def test_definitions_that_a_scene_takes_for_parameters(command):
    below, call = command
    folder = below("dollar")
    fill(folder)
    code, _, err = call("render", "slab.xml", "-D", f"table={folder}/dust.txt")
    assert code == 2 and "without $, which stands for a parameter" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [
        pytest.param({"LC_ALL": "C"}, marks=pytest.mark.slow),
        pytest.param(
            {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
            marks=pytest.mark.slow,
        ),
        {"PYTHONIOENCODING": "ascii"},
    ],
)
def test_terminals_of_few_characters(tmp_path, environment):
    (tmp_path / "tiny.yaml").write_text(TINY + "# Größe\n", encoding="utf-8")
    told = {**os.environ, **environment}
    done = shell("check", tmp_path / "tiny.yaml", env=told, errors="replace")
    assert done.returncode == 0 and "all checks passed" in done.stdout, done.stderr
    done = shell("info", tmp_path / "Größe", env=told, errors="replace")
    assert done.returncode == 2 and done.stderr.startswith("lidar-mi: "), done.stderr


def test_a_console_prints_what_it_has_no_character_for_as_escapes():
    stream = io.TextIOWrapper(io.BytesIO(), "ascii")
    Terminal(file=stream, width=80).print("10 ± 2°")
    stream.flush()
    assert stream.buffer.getvalue() == b"10 \\xb1 2\\xb0\n"


def test_text_files_of_other_systems(tmp_path):
    """A mark before UTF-8, ends of lines of other systems; other encodings are named."""
    path = tmp_path / "a"
    for content in (TINY.replace("\n", "\r\n").encode(), b"\xef\xbb\xbf" + TINY.encode()):
        path.write_bytes(content)
        assert read_yaml(path, "an experiment") == read_yaml_text(TINY, tmp_path)
    path.write_bytes(b"\xef\xbb\xbf{}")
    assert read_json(path, "numbers") == {}
    path.write_bytes("\ufefft (s),roll (deg)\r\n0,1\r\n1,2\r\n".encode())
    assert read_timed_table(path, {"roll": "rad"})["t"].tolist() == [0, 1]
    for content, said in (
        ("# a\n# Größe\n".encode("latin-1"), "line 2 is not UTF-8.*iconv -f LATIN1 -t UTF-8"),
        ("t\n".encode("utf-16"), "line 1 is not UTF-8.*iconv -f UTF-16 -t UTF-8"),
        (b"\x89HDF\xff\x00\x01", "not a text file"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=said):
            read_text(path, "a table")


def read_yaml_text(text, folder):
    (folder / "plain").write_text(text)
    return read_yaml(folder / "plain", "an experiment")


def test_names_that_are_not_utf8_survive_in_records(tmp_path):
    path = tmp_path / "record"
    path.write_text(to_yaml({"beside": os.fsdecode(b"/tmp/B\xf6rse")}), encoding="utf-8")
    assert os.fsencode(read_yaml(path, "a record")["beside"]) == b"/tmp/B\xf6rse"
