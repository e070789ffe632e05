"""Atomic writing: unit tests. Detect a file half written or left behind by a write that fails."""

import pytest

from lidar_mi.io.atomic import write_atomically


def test_the_file_appears_whole(tmp_path):
    def write(part):
        assert part.parent == tmp_path and part.suffix == ".json"
        part.write_text("half")
        assert not (tmp_path / "a.json").exists()
        part.write_text("whole")

    write_atomically(tmp_path / "a.json", write)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.json", "whole")]


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write(part):
        part.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, write)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]
