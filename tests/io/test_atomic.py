"""Atomic writing: unit tests.

Detect a file half written or left behind by a write that fails, a temporary file of a killed
process that stays, one of a living process that is removed, a special file that is replaced, and a
rename of what is not on the disk yet.
"""

import errno
import os
import subprocess
import sys

import pytest

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import TEMPORARY, write_atomically


def content(folder):
    return [(path.name, path.read_text()) for path in folder.iterdir()]


def test_the_file_appears_whole(tmp_path):
    def look():
        (temporary,) = tmp_path.iterdir()
        assert temporary.match(TEMPORARY) and temporary.read_text() == "whole"

    write_atomically(tmp_path / "a.json", b"whole", first=look)
    assert content(tmp_path) == [("a.json", "whole")]


def test_a_write_that_is_stopped_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new", first=stop)
    assert content(tmp_path) == [("a.txt", "old")]


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_a_disk_that_fails_leaves_the_old_file(tmp_path, monkeypatch, call, number):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(InputError, match=rf"a.txt: cannot be written \({os.strerror(number)}\)"):
        write_atomically(path, b"new")
    assert content(tmp_path) == [("a.txt", "old")]


def test_content_and_name_are_synced_about_the_rename(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)

        def call(*given, name=name, real=real):
            about = os.readlink(f"/proc/self/fd/{given[0]}") if name == "fsync" else given[0]
            calls.append((name, os.path.basename(about)))
            return real(*given)

        monkeypatch.setattr(os, name, call)
    write_atomically(tmp_path / "a.txt", b"new")
    temporary = calls[0][1]
    assert calls == [("fsync", temporary), ("replace", temporary), ("fsync", tmp_path.name)]


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    code = (
        "import os, sys; from lidar_mi.io.atomic import write_atomically\n"
        "kill = lambda: os.kill(os.getpid(), 9)\n"
        f"write_atomically({str(tmp_path / 'a.txt')!r}, b'new', first=kill)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    (left,) = tmp_path.iterdir()
    write_atomically(tmp_path / "b.txt", b"b")
    assert not left.exists() and content(tmp_path) == [("b.txt", "b")]


def test_temporary_files_of_living_processes_stay(tmp_path):
    def write_another():
        write_atomically(tmp_path / "b.txt", b"b")

    write_atomically(tmp_path / "a.txt", b"a", first=write_another)
    assert sorted(content(tmp_path)) == [("a.txt", "a"), ("b.txt", "b")]


def test_no_ordinary_file_is_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "folder", tmp_path / "pipe", "/dev/null"):
        with pytest.raises(InputError, match="is no ordinary file"):
            write_atomically(place, b"new")
    assert os.path.exists("/dev/null") and not os.path.isfile("/dev/null")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "pipe"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [("x" * 256, "File name too long"), ("none/a", "is no folder"), ("file/a", "is no folder")],
)
def test_places_that_cannot_be(tmp_path, name, reason):
    (tmp_path / "file").write_text("old")
    with pytest.raises(InputError, match=reason):
        write_atomically(tmp_path / name, b"new")
    assert content(tmp_path) == [("file", "old")]


def test_the_longest_name_is_written(tmp_path):
    write_atomically(tmp_path / ("x" * 255), b"new")
    assert content(tmp_path) == [("x" * 255, "new")]
