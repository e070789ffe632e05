"""Pictures of every kind become the same numbers, and `lidar-mi rings` measures them.

Detects: a kind of file that is read with other values, upside down or not at all, a layer or
colour that is taken for another, and files that end in a traceback.
"""

import sys

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from lidar_mi import cli
from lidar_mi.errors import InputError
from lidar_mi.pictures import read_picture


@pytest.fixture
def values():
    y, x = np.mgrid[:260, :330]
    order = ((x - 160.3) ** 2 + (y - 121.8) ** 2) / 6000
    return (20 + 150 / (1 + 30 * np.sin(np.pi * (order - 0.4)) ** 2)).round()


def write_exr(path, **layers):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: layer.astype(np.float32) for name, layer in layers.items()}
    OpenEXR.File(header, channels).write(str(path))


def test_every_kind_holds_the_same(tmp_path, values):
    fits = pytest.importorskip("astropy.io.fits")
    grey = Image.fromarray(values.astype(np.uint8))
    grey.save(tmp_path / "a.png")
    grey.save(tmp_path / "a.tif")
    Image.fromarray(values.astype(np.uint16)).save(tmp_path / "wide.png")
    Image.fromarray(values.astype(np.float32)).save(tmp_path / "float.tiff")
    Image.merge("RGBA", [grey, grey, grey, grey.point(lambda _: 9)]).save(tmp_path / "alpha.png")
    fits.PrimaryHDU(values.astype(np.float32)).writeto(tmp_path / "a.fits")
    write_exr(tmp_path / "a.exr", Y=values, noise=0 * values)
    write_exr(tmp_path / "rgb.exr", R=values - 1, G=values, B=values + 1)
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(read_picture(path), values, err_msg=path.name)
    grey.save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_picture(tmp_path / "a.jpg") - values).max() < 12
    assert not read_picture(tmp_path / "a.exr", "noise").any()


def test_files_that_are_none(tmp_path, values):
    write_exr(tmp_path / "two.exr", a=values, b=values)
    for name in ("bad.png", "bad.exr", "bad.fits"):
        (tmp_path / name).write_bytes(b"no picture")
    (tmp_path / "good.png").write_bytes(b"")
    for name, layer, message in (
        ("none.png", None, "no such file; expected an EXR, PNG, TIFF, JPEG or FITS image"),
        ("bad.png", None, "no readable image"),
        ("bad.fits", None, "FITS"),
        ("bad.exr", None, "bad.exr"),
        ("good.png", "Y", "only EXR files have layers"),
        ("two.exr", None, "expected a layer to be named, one of a, b"),
        ("two.exr", "c", "layer 'c' is not there; expected one of a, b"),
    ):
        with pytest.raises(InputError, match=message) as stop:
            read_picture(tmp_path / name, layer)
        assert "\n" not in str(stop.value)


def test_the_command(tmp_path, values, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Image.fromarray(values.astype(np.uint8)).save("rings.png")
    Image.fromarray(np.full((50, 60), 7, np.uint8)).save("even.png")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["lidar-mi", *arguments])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return stop.value.code or 0, *capsys.readouterr()

    code, out, _ = call("rings", "rings.png")
    assert code == 0 and "160.3" in out and "0.40" in out
    assert np.asarray(Image.open("rings_rings.png")).std() > 10
    code, _, err = call("rings", "even.png")
    assert code == 2 and err.startswith("lidar-mi: even.png: ") and err.count("\n") == 1
