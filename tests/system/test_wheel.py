"""The distributions. Detects a module, a scene or a file of the report that the wheel lacks, code
that works in the source tree only, a source distribution that makes another wheel, and a
description that the package index would not show.
"""

import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import lidar_mi

ROOT = Path(__file__).resolve().parents[2]
# in the source tree -> in the wheel
ROOMS = {"lidar_mi": "lidar_mi", "plugins": "lidar_mi/plugins", "scenes": "lidar_mi/scenes"}

pytestmark = pytest.mark.skipif(
    not (ROOT / "pyproject.toml").is_file(), reason="a wheel is built from the source tree"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Folder that the wheel is unpacked in, far from the source tree."""
    pytest.importorskip("setuptools", minversion="77", reason="setuptools builds the wheel")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    command += ["--wheel-dir", folder, _copied(folder)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return _unpacked(folder, folder / "installed")


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """Folder of the source distribution, and of the wheel that is made of it."""
    pytest.importorskip("build", reason="build is not installed (extra release)")
    folder = tmp_path_factory.mktemp("distributions")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist"]
    built = subprocess.run([*command, _copied(folder)], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder / "dist"


def _copied(folder):
    """The source tree, as far as a wheel is made of it."""
    source = folder / "source"
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source / file)
    return source


def _unpacked(folder, installed):
    (archive,) = folder.glob("lidar_mi-*.whl")
    zipfile.ZipFile(archive).extractall(installed)
    return installed


def _files(folder):
    packed = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    return {name for name in packed if name.startswith("lidar_mi/")}


def test_every_folder_of_modules_is_packed():
    """As listed: building a wheel takes long."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        packages = tomllib.load(file)["tool"]["setuptools"]["packages"]
    folders = {path.parent for room in ROOMS for path in (ROOT / room).rglob("__init__.py")}
    names = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    expected = {n if n.startswith("lidar_mi") else f"lidar_mi.{n}" for n in names}
    assert expected == {name for name in packages if name != "lidar_mi.scenes.instruments"}


@pytest.mark.slow
def test_holds_every_file(wheel):
    expected = {
        (Path(there) / path.relative_to(ROOT / here)).as_posix()
        for here, there in ROOMS.items()
        for path in (ROOT / here).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"lidar_mi/units.py", "lidar_mi/plugins/laser.py", "lidar_mi/scenes/slab.xml"} < expected
    assert _files(wheel) == expected


def test_source_distribution_makes_the_same_wheel(distributions, wheel, tmp_path):
    (source,) = distributions.glob("lidar_mi-*.tar.gz")
    assert source.name == f"lidar_mi-{lidar_mi.__version__}.tar.gz"
    assert _files(_unpacked(distributions, tmp_path / "installed")) == _files(wheel)


def test_package_index_would_take_them(distributions):
    pytest.importorskip("twine", reason="twine is not installed (extra release)")
    command = [sys.executable, "-m", "twine", "check", "--strict", *distributions.iterdir()]
    checked = subprocess.run(command, capture_output=True, text=True)
    assert checked.returncode == 0 and checked.stdout.count("PASSED") == 2, checked.stdout


@pytest.mark.slow
def test_works_elsewhere(wheel, tmp_path):
    """A shipped experiment and its wake are found beside the installed package."""
    program = (
        f"import sys; sys.path.insert(0, {str(wheel)!r})\n"
        "import lidar_mi, lidar_mi.plugins, lidar_mi.scenes\n"
        "for module in (lidar_mi, lidar_mi.plugins, lidar_mi.scenes):\n"
        f"    assert module.__file__.startswith({str(wheel)!r}), module.__file__\n"
        "from lidar_mi.cli.app import main\n"
        "sys.argv = ['lidar-mi', 'check', 'wake_backscatter']\n"
        "main()\n"
    )
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ran.returncode == 0, ran.stdout + ran.stderr
