"""A disk that is really full: a file system of two megabytes in memory, filled up.

Detects a half-written file, a lost earlier one, a traceback or a signal where one line is due, and
a run that cannot be resumed once there is room. Skipped where mounting is not permitted.
"""

import os
import subprocess

import numpy as np
import pytest
from PIL import Image

MIB = 1 << 20


@pytest.fixture
def disk(tmp_path):
    """A folder on a small disk of its own."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("no command mount")
    if done.returncode:
        pytest.skip(f"mounting is not permitted: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill(disk, left):
    """Leave so many bytes of room."""
    room = os.statvfs(disk)
    with open(disk / "ballast", "wb") as file:
        file.write(bytes(room.f_bavail * room.f_frsize - left))
        os.fsync(file.fileno())


def content(disk):
    return {path.name: path.read_bytes() for path in disk.rglob("*") if path.is_file()}


def test_a_wind_that_has_no_room(disk, there, lidar_mi):
    """In NetCDF, whose library dies of it."""
    air = np.random.default_rng(1).integers(0, 255, (40, 48), dtype=np.uint8)
    for name, shift in (("a.png", 0), ("b.png", 2)):
        Image.fromarray(np.roll(air, shift, 1)).save(there / name)
    (disk / "w.nc").write_bytes(b"mine")
    fill(disk, 4096)
    kept = content(disk)
    images = ("a.png", "b.png", "--dt", "1", "--spacing", "1", "--stride", "4")
    command = ("retrieve", *images, "-o", disk / "w.nc", "--overwrite")
    code, _, err = lidar_mi(*command)
    assert code == 2 and "w.nc: cannot be written (No space left on device)" in err.splitlines()[-1]
    assert content(disk) == kept
    (disk / "ballast").unlink()
    assert lidar_mi(*command)[0] in (0, 1)
    assert (disk / "w.nc").read_bytes().startswith(b"\x89HDF")


@pytest.mark.slow
@pytest.mark.parametrize(
    "left",
    [
        pytest.param(0, marks=pytest.mark.slow),
        20_000,
        pytest.param(150_000, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_has_no_room(disk, there, lidar_mi, quick, left):
    """For its record, for an image, for its results: resumed when there is room."""
    fill(disk, left)
    code, _, err = lidar_mi("run", "tiny.yaml", "-o", disk / "run")
    assert code == 2 and "Traceback" not in err
    assert "No space left on device" in err.splitlines()[-1]
    assert not [name for name in content(disk) if name.startswith(".")]
    assert not (disk / "run" / "metrics.json").exists()
    (disk / "ballast").unlink()
    assert lidar_mi("run", "tiny.yaml", "-o", disk / "run")[0] == 0
    assert (disk / "run" / "metrics.json").is_file()
