"""The wheel. Detects a module, a scene or a file of the report that it lacks, and code that works
in the source tree only.
"""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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
    source = folder / "source"
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source / file)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    built = subprocess.run(
        [*command, "--wheel-dir", folder, source], capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    (archive,) = folder.glob("lidar_mi-*.whl")
    zipfile.ZipFile(archive).extractall(folder / "installed")
    return folder / "installed"


def test_holds_every_file(wheel):
    expected = {
        (Path(there) / path.relative_to(ROOT / here)).as_posix()
        for here, there in ROOMS.items()
        for path in (ROOT / here).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"lidar_mi/units.py", "lidar_mi/plugins/laser.py", "lidar_mi/scenes/slab.xml"} < expected
    packed = {path.relative_to(wheel).as_posix() for path in wheel.rglob("*") if path.is_file()}
    packed = {name for name in packed if name.startswith("lidar_mi/")}
    assert packed == expected


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
