"""Targets of commands: unit tests.

Detect an input, a device or someone else's file that is replaced unasked, and a result of ours that
is not known again.
"""

import os

import pytest
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.errors import InputError
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.png import write_png
from lidar_mi.io.target import check_target, software


def test_new_names_are_free(tmp_path):
    check_target(tmp_path / "new.nc")
    with pytest.raises(InputError, match="none is no folder"):
        check_target(tmp_path / "none" / "new.nc")


def test_an_input_is_never_a_target(tmp_path):
    path = tmp_path / "a.exr"
    path.write_text("an image")
    os.link(path, tmp_path / "hard.exr")
    (tmp_path / "soft.exr").symlink_to(path)
    for name in ("a.exr", "hard.exr", "soft.exr"):
        with pytest.raises(InputError, match="is an input"):
            check_target(tmp_path / name, [tmp_path / "other.exr", path], overwrite=True)


def test_no_ordinary_file_is_never_a_target(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "null", "/dev/null"):
        with pytest.raises(InputError, match="is no ordinary file"):
            check_target(path, overwrite=True)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"my notes on lidar-mi 0.1\n",
        b"v/1\x01 lidar-mi",
        b"\x89HDF\r\n\x1a\n",
        b"\x89PNG",
        b"\xff",
    ],
)
def test_foreign_files_are_replaced_only_on_request(tmp_path, content):
    path = tmp_path / "theirs"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"does not say that lidar-mi wrote it .*--overwrite"):
        check_target(path)
    check_target(path, overwrite=True)
    assert path.read_bytes() == content


def test_winds_of_others_are_not_ours(tmp_path):
    write_netcdf(xr.Dataset({"v": 1.0}), tmp_path / "theirs.nc")
    assert software(tmp_path / "theirs.nc") == ""
    write_netcdf(xr.Dataset({"v": 1.0}, attrs={"software": "lidar-mi 1"}), tmp_path / "ours.nc")
    check_target(tmp_path / "ours.nc")


def test_our_images_are_recognised(tmp_path):
    write_png(Figure(), tmp_path / "ours.png")
    check_target(tmp_path / "ours.png")
    Figure().savefig(tmp_path / "theirs.png")
    with pytest.raises(InputError, match="does not say"):
        check_target(tmp_path / "theirs.png")
