"""Frames of a file as images: ``retrieve`` on pages, stacks and cubes; images that are the same.

Detects one page that is taken for two images, channels or an ambiguous stack that are taken for
times, a colour or a depth that changes the wind, and images twice of which nothing is said.
"""

import numpy as np
import pytest
import tifffile
import xarray as xr
from PIL import Image
from scipy.ndimage import fourier_shift, gaussian_filter

from tests.support.image_files import png_bytes

OPTIONS = "--dt", "0.1", "--spacing", "0.5", "--method", "cc", "--stride", "4", "--overwrite"


def exposures(count=2, scale=900.0):
    """Air that moves by 5 and -2.5 m/s: in 0.1 s one pixel of 0.5 m to the left, half one down."""
    texture = gaussian_filter(np.random.default_rng(1).standard_normal((60, 80)), 2, mode="wrap")
    first = 3 * scale + scale * texture / texture.std()
    moved = [np.fft.ifft2(fourier_shift(np.fft.fft2(first), (0.5 * n, -n))) for n in range(count)]
    return [np.round(one.real).astype(np.uint16) for one in moved]


def pages(name, images):
    first, *more = (Image.fromarray(image) for image in images)
    first.save(name, save_all=True, append_images=more)


def of_file(path="wind.nc"):
    with xr.open_dataset(path) as wind:
        valid = wind["flag"] == 0
        means = [float(wind[name].where(valid).median()) for name in ("v", "w")]
        return means, wind.load()


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("kind", ["tif", "ome", "imagej", "fits", "npy", "pgm", "im7"])
def test_a_file_of_two_frames_is_a_pair(here, lidar_mi, kind):
    images = np.stack(exposures())
    name = f"pair.{'tif' if kind in ('ome', 'imagej') else kind}"
    if kind == "tif":
        pages(name, images)
    elif kind in ("ome", "imagej"):
        tifffile.imwrite(name, images, **{kind: True}, metadata={"axes": "TYX"})
    elif kind == "fits":
        pytest.importorskip("astropy.io.fits").PrimaryHDU(images).writeto(name)
    elif kind == "npy":
        np.save(name, images)
    elif kind == "im7":
        lvpyio = pytest.importorskip("lvpyio")
        lvpyio.write_buffer(lvpyio.arrays_to_buffer(list(images)), name)
    else:
        head = b"P5 80 60 65535\n"
        (here / name).write_bytes(b"".join(head + one.astype(">u2").tobytes() for one in images))
    code, out, _ = lidar_mi("retrieve", name, *OPTIONS)
    assert code == 0 and "warning" not in out
    (v, w), _ = of_file()
    assert v == pytest.approx(5, abs=0.3) and w == pytest.approx(-2.5, abs=0.3)


def test_frames_are_named(here, lidar_mi):
    pages("stack.tif", exposures(4))
    code, _, err = lidar_mi("retrieve", "stack.tif", *OPTIONS)
    assert code == 2 and err.count("\n") == 1
    assert "stack.tif: 4 frames; expected frame" in err and "pairs all" in err
    assert lidar_mi("retrieve", "stack.tif", "--frame", "1,2", *OPTIONS)[0] == 0
    (v, w), _ = of_file()
    assert v == pytest.approx(5, abs=0.3) and w == pytest.approx(-2.5, abs=0.3)
    assert lidar_mi("retrieve", "stack.tif", "--frame", "2,1", *OPTIONS)[0] == 0
    assert of_file()[0][0] == pytest.approx(-5, abs=0.3)
    assert lidar_mi("retrieve", "stack.tif", "--pairs", "0-1,1-3", *OPTIONS)[0] == 0
    _, winds = of_file()
    assert winds.sizes["time"] == 2
    np.testing.assert_allclose(winds["v"].median(("z", "y")), 5, atol=0.3)
    pages("other.tif", exposures(4))
    assert lidar_mi("retrieve", "stack.tif", "other.tif", "--frame", "0,1", *OPTIONS)[0] == 0
    assert of_file()[0][0] == pytest.approx(5, abs=0.3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("one.tif",), "one.tif: one image; expected two files"),
        (("pair.tif", "pair.tif"), "pair.tif: 2 frames; expected frame with a number for each"),
        (("one.tif", "pair.tif", "--pairs", "all"), "pair.tif: 2 frames; expected frame"),
        (("pair.tif", "--frame", "0"), "frame: one frame of pair.tif; expected two"),
        (("pair.tif", "--frame", "0,2"), "frame 2 is not there; expected --frame 0 to 1"),
        (("pair.tif", "--frame", "a"), "--frame: 'a' is not allowed; expected numbers from 0"),
        (("pair.tif", "--frame", "0,1", "--pairs", "all"), "frame, pairs: both"),
        (("one.tif", "one.tif", "--frame", "0,0,0"), "3 numbers are not allowed with 2 files"),
        (("colours.tif",), "colours.tif: 2 channels of one moment"),
        (("axes.tif",), "axes.tif: images along several axes (T 2, Z 2)"),
        (("none.tif",), "none.tif: no such file"),
    ],
)
def test_what_is_ambiguous_is_refused(here, lidar_mi, arguments, says):
    images = np.stack(exposures())
    pages("pair.tif", images)
    pages("one.tif", images[:1])
    tifffile.imwrite("colours.tif", images, imagej=True, metadata={"axes": "CYX"})
    tifffile.imwrite("axes.tif", np.stack([images, images]), imagej=True, metadata={"axes": "TZYX"})
    code, out, err = lidar_mi("retrieve", *arguments, *OPTIONS)
    assert code == 2 and says in err and err.count("\n") == 1, (out, err)
    assert not (here / "wind.nc").exists()


@pytest.mark.slow
def test_identical_images_are_remarked_on(here, lidar_mi):
    images = exposures()
    pages("same.tif", [images[0], images[0]])
    Image.fromarray(images[0]).save("a.png")
    words = "are the same, bit for bit"
    for files in (("same.tif",), ("a.png", "a.png"), ("same.tif", "--pairs", "all")):
        code, out, err = lidar_mi("retrieve", *files, *OPTIONS)
        assert code == 1 and words in " ".join(out.split())
        assert "no valid vector of " in err and (here / "wind.nc").is_file()
    pages("pair.tif", images)
    assert words not in lidar_mi("retrieve", "pair.tif", *OPTIONS)[1]
    # air has no rings, but that both frames are one is said before
    for option in ("--all", "--average"):
        assert f"frames 0 and 1 {words}" in lidar_mi("rings", "same.tif", option)[1]


def test_depth_of_colour_does_not_change_the_wind(here, lidar_mi):
    """12 bits in 16-bit colour: the wind of the grey images, digit by digit."""
    images = exposures(scale=600)
    assert max(image.max() for image in images) < 4096
    for number, image in enumerate(images):
        content = png_bytes(np.repeat(image[..., None].astype(int), 3, -1), 16, 2)
        (here / f"colour{number}.png").write_bytes(content)
        Image.fromarray(image).save(f"grey{number}.png")
    assert lidar_mi("retrieve", "grey0.png", "grey1.png", *OPTIONS)[0] == 0
    _, grey = of_file()
    assert lidar_mi("retrieve", "colour0.png", "colour1.png", *OPTIONS)[0] == 0
    xr.testing.assert_identical(of_file()[1], grey)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "mat", "vtk", "flo"])
def test_the_name_says_the_format(here, lidar_mi, suffix):
    pages("pair.tif", exposures())
    code, out, _ = lidar_mi("retrieve", "pair.tif", *OPTIONS, "-o", f"w.{suffix}")
    assert code == 0 and f"w.{suffix}" in out and "lost" in out
    assert not (here / f"w.{suffix}").read_bytes().startswith(b"\x89HDF")
