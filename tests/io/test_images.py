"""Images of every kind become the same numbers in every command, and `rings` measures them.

Detects: a kind of file that is read with other values, upside down, mirrored or not at all, a layer
or colour that is taken for another or read by two rules, a wrong spacing, and files that end in a
traceback.
"""

import importlib
import re
import struct
import sys
import tracemalloc
from zlib import crc32

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from lidar_mi.cli import app as cli
from lidar_mi.errors import InputError
from lidar_mi.io.images import as_webp, read_image, read_pixels
from lidar_mi.retrieval.rings import analysis as rings


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
    grey.save(tmp_path / "a.bmp")
    Image.fromarray(values.astype(np.uint16)).save(tmp_path / "wide.png")
    Image.fromarray(values.astype(np.float32)).save(tmp_path / "float.tiff")
    Image.merge("RGBA", [grey, grey, grey, grey.point(lambda _: 9)]).save(tmp_path / "alpha.png")
    fits.PrimaryHDU(values.astype(np.float32)).writeto(tmp_path / "a.fits")
    write_exr(tmp_path / "a.exr", Y=values, noise=0 * values)
    write_exr(tmp_path / "noisy.exr", Y=0 * values, Y_noisy=values)
    write_exr(tmp_path / "rgb.exr", R=values - 1, G=values, B=values + 1)
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(read_pixels(path), values, err_msg=path.name)
    grey.save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_pixels(tmp_path / "a.jpg") - values).max() < 12
    assert not read_pixels(tmp_path / "a.exr", "noise").any()


def test_files_that_are_none(tmp_path, values):
    write_exr(tmp_path / "two.exr", a=values, b=values)
    for name in ("bad.png", "bad.exr", "bad.fits"):
        (tmp_path / name).write_bytes(b"no picture")
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(tmp_path / "good.png")
    for name, layer, message in (
        (
            "none.png",
            None,
            r"no such file; expected an image \(EXR, PNG, TIFF, BMP, JPEG, FITS, npy, npz,",
        ),
        ("bad.png", None, "no readable image"),
        ("bad.fits", None, "FITS"),
        ("bad.exr", None, "bad.exr"),
        ("good.png", "Y", "only EXR, FITS, npz, mat and HDF5 files have layers"),
        ("two.exr", None, "expected a layer to be named, one of a, b"),
        ("two.exr", "c", "layer 'c' is not there; expected one of a, b"),
    ):
        with pytest.raises(InputError, match=message) as stop:
            read_pixels(tmp_path / name, layer)
        assert "\n" not in str(stop.value)


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [
        ("png", np.uint8),
        ("bmp", np.uint8),
        ("tif", np.uint8),
        ("png", np.uint16),
        ("tif", np.uint16),
        ("tif", np.float32),
    ],
)
def test_values_and_axes_survive(tmp_path, suffix, kind):
    values = (np.arange(12).reshape(3, 4) * 20).astype(kind)
    if kind is np.uint16:
        values = values * 250
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(values).save(path)
    image = read_image(path, spacing=0.5)
    # top left is largest z and largest y
    assert float(image.sel(z=0.5, y=0.75)) == values[0, 0]
    assert float(image.sel(z=-0.5, y=0.25)) == values[2, 1]
    np.testing.assert_array_equal(image.values[::-1, ::-1], values)
    assert image.z.attrs["units"] == image.y.attrs["units"] == "m"


@pytest.mark.parametrize("spacing", [None, 0.0, -1.0, np.nan])
def test_spacing_is_needed(tmp_path, spacing):
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(path)
    words = "--spacing in m" if spacing is None else "spacing: .* expected a number above 0"
    with pytest.raises(InputError, match=words):
        read_image(path, spacing=spacing)


def test_a_colour_image_is_the_same_to_both_commands(tmp_path, monkeypatch):
    """The mean of the colours, transparency left out."""
    random = np.random.default_rng(2)
    colours = random.integers(0, 256, (40, 50, 4), dtype=np.uint8)
    Image.fromarray(colours).save(tmp_path / "colours.png")
    monkeypatch.chdir(tmp_path)
    given = []

    def stop(image, *_, **__):
        given.append(np.asarray(image))
        raise InputError("that was it")

    monkeypatch.setattr(rings, "analyse_rings", stop)
    image_files = importlib.import_module("lidar_mi.experiment.image_files")
    monkeypatch.setattr(image_files, "retrieve_wind", stop)
    for command in (
        ["rings", "colours.png"],
        ["retrieve", "colours.png", "colours.png", "--dt", "1", "--spacing", "1"],
    ):
        monkeypatch.setattr(sys, "argv", ["lidar-mi", *command])
        with pytest.raises(SystemExit):
            cli.main()
    to_rings, to_retrieve = given
    np.testing.assert_allclose(to_rings, colours[..., :3].sum(-1) / 3.0, rtol=1e-12)
    # z and y ascend: the last row is the image's top, the last column its left
    np.testing.assert_array_equal(to_retrieve[::-1, ::-1], to_rings)


@pytest.mark.slow
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
    centre, fraction = (re.search(rf"{row}[^\d]*([\d.]+) ±", out) for row in ("x, y", "order at"))
    assert code == 0 and centre and fraction, out
    assert float(centre[1]) == pytest.approx(160.3, abs=0.01)
    assert float(fraction[1]) == pytest.approx(0.4, abs=0.001)
    assert np.asarray(Image.open("rings_rings.png")).std() > 10
    code, _, err = call("rings", "even.png")
    assert code == 2 and err.startswith("lidar-mi: even.png: ") and err.count("\n") == 1


def test_webp_is_lossless(tmp_path):
    pixels = np.random.default_rng(3).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    (tmp_path / "a.webp").write_bytes(as_webp(tmp_path / "a.png"))
    with Image.open(tmp_path / "a.webp") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)
    with pytest.raises(InputError, match=r"no.png: no readable image"):
        as_webp(tmp_path / "no.png")


DATA = struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", crc32(b"IDAT"))


def png_header(width, height):
    """The first bytes of a grey PNG."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + chunk
        + struct.pack(">I", crc32(chunk))
        + DATA
    )


def fits_header(width, height):
    cards = (
        "SIMPLE  = T",
        "BITPIX  = 8",
        "NAXIS   = 2",
        f"NAXIS1  = {width}",
        f"NAXIS2  = {height}",
    )
    return "".join(f"{card:80}" for card in (*cards, "END")).ljust(2880).encode()


@pytest.mark.parametrize(("suffix", "header"), [(".png", png_header), (".fits", fits_header)])
def test_what_a_file_declares_is_not_believed(tmp_path, suffix, header):
    """Of 12 000 x 12 000 pixels a few bytes are there: refused before memory is asked for."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(header(12_000, 12_000))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"declares 1\.15e\+09 bytes in a file of \d"):
            read_pixels(path)
        assert tracemalloc.get_traced_memory()[1] < 1e8
    finally:
        tracemalloc.stop()
