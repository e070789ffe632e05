"""Every kind of image file gives the values that it holds, or one line that says what to do.

Detects depth, sign, planes, pages or scaling that a reader changes in silence, channels and axes
that are taken for others, and a file that is cut off and gives values that it never held. The files
are made by other programs or byte by byte (`tests.support.image_files`).
"""

import itertools

import numpy as np
import pytest
import tifffile
from PIL import Image

from lidar_mi.errors import InputError
from lidar_mi.io.images import read_frames, read_image, read_pixels
from tests.support import image_files as files


@pytest.mark.parametrize("kind", [*files.WHOLE, *files.FLOATS])
def test_tiff_of_every_type_compression_and_layout(kind):
    """All pairs of compression and layout; predictor, pages, order, tiles, BigTIFF at random."""
    rng = np.random.default_rng(list(kind.encode()))
    read = 0
    for compression, channels in itertools.product(files.COMPRESSIONS, files.CHANNELS):
        try:
            made = files.tiff(rng, kind, compression, channels)
        except files.Unwritable:
            continue
        assert files.fault(made) is None
        read += 1
    # of types beyond 16 bits six compressions are exact, of floats as well
    assert read >= 6 * len(files.CHANNELS) - len(files.CHANNELS)


@pytest.mark.parametrize("sort", [sort for sort in files.SORTS if sort != "tiff"])
def test_every_sort_of_file(sort):
    for seed in range(60):
        made = files.made(np.random.default_rng([seed, len(sort)]), sort)
        assert files.fault(made) is None


@pytest.mark.parametrize("seed", range(0, 200, 50))
def test_whole_and_cut_off(seed):
    """What `make fuzz` tries for longer."""
    assert [found for k in range(50) if (found := files.check(seed + k))] == []


def test_colour_keeps_its_depth(tmp_path):
    """12 bits in 16-bit colour: all 4096 values, as a camera writes them."""
    values = np.arange(64 * 64).reshape(64, 64)
    content = files.png_bytes(np.repeat(values[..., None], 3, -1), 16, 2)
    (tmp_path / "a.png").write_bytes(content)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), values)
    tifffile.imwrite(tmp_path / "a.tif", np.repeat(values[..., None], 3, -1).astype("u2"))
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), values)


def test_white_as_zero_is_refused_at_every_depth(tmp_path):
    for kind in ("u1", "u2", "f4"):
        tifffile.imwrite(tmp_path / "a.tif", np.ones((4, 5), kind), photometric="miniswhite")
        with pytest.raises(InputError, match="0 is white"):
            read_pixels(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"photometric": "separated", "channels": 4}, "pixels are SEPARATED"),
        ({"photometric": "cielab", "channels": 3}, "pixels are CIELAB"),
        ({"photometric": "cfa"}, "pixels are CFA"),
        ({"tag": (259, 34661)}, "compressed by JBIG, which is not read"),
        ({"kind": "c8"}, "complex"),
    ],
)
def test_what_is_no_grey_and_no_colour_is_named(tmp_path, options, says):
    channels, kind = options.get("channels", 1), options.get("kind", "u1")
    data = np.ones((16, 16, channels)[: 3 if channels > 1 else 2], kind)
    tifffile.imwrite(
        tmp_path / "a.tif",
        data,
        photometric=options.get("photometric", "minisblack"),
        metadata=None,
    )
    if "tag" in options:
        with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
            file.pages[0].tags[options["tag"][0]].overwrite(options["tag"][1])
    with pytest.raises(InputError, match=says):
        read_pixels(tmp_path / "a.tif")


def test_luma_is_turned_into_colours(tmp_path):
    """JPEG within TIFF, colour at half the resolution; a smooth image survives it."""
    y, x = np.mgrid[:32, :32] * 3
    colours = np.stack([y + 60, 200 - x, x + 80], -1).astype("u1")
    tifffile.imwrite(
        tmp_path / "a.tif",
        colours,
        photometric="rgb",
        compression="jpeg",
        compressionargs={"level": 95},
    )
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].photometric.name == "YCBCR"
    assert np.abs(read_pixels(tmp_path / "a.tif") - files.mean(colours)).max() < 6


def test_shallow_bitmaps_are_refused(tmp_path):
    """BMP of 5 bits a colour, which would be spread over 0 to 255."""
    head = b"BM" + (14 + 40 + 32).to_bytes(4, "little") + bytes(4) + (54).to_bytes(4, "little")
    about = b"".join(n.to_bytes(4, "little") for n in (40, 4, 4)) + b"\1\0\x10\0" + bytes(24)
    (tmp_path / "a.bmp").write_bytes(head + about + bytes(range(32)))
    with pytest.raises(InputError, match="BMP of 16 bits a pixel"):
        read_pixels(tmp_path / "a.bmp")


def test_a_frame_of_several(tmp_path):
    path = tmp_path / "a.tif"
    pages = np.random.default_rng(1).integers(0, 60000, (3, 8, 9)).astype("u2")
    first, *more = (Image.fromarray(page) for page in pages)
    first.save(path, save_all=True, append_images=more)
    np.testing.assert_array_equal(read_frames(path), pages)
    np.testing.assert_array_equal(read_frames(path, numbers=[2, 0]), pages[[2, 0]])
    for frame, page in enumerate(pages):
        np.testing.assert_array_equal(read_pixels(path, frame=frame), page)
        image = read_image(path, spacing=0.5, frame=frame)
        np.testing.assert_array_equal(image.values[::-1, ::-1], page)
    with pytest.raises(InputError, match=r"a.tif: 3 frames; expected --frame, 0 to 2"):
        read_pixels(path)
    with pytest.raises(InputError, match=r"frame 3 is not there; expected --frame 0 to 2"):
        read_pixels(path, frame=3)


def test_pages_that_share_their_pixels_are_no_bomb(tmp_path):
    """1000 pages of the same megabyte: refused before memory is asked for."""
    with tifffile.TiffWriter(tmp_path / "a.tif", byteorder=">") as file:
        file.write(np.zeros((1024, 1024), "u1"), metadata=None, rowsperstrip=1024)
    content = (tmp_path / "a.tif").read_bytes()
    start = int.from_bytes(content[4:8], "big")
    size = 2 + 12 * int.from_bytes(content[start : start + 2], "big")
    page, content = content[start : start + size], content + bytes(len(content) % 2)
    ends = [len(content) + (k + 1) * (size + 4) for k in range(1000)]
    content = content[:4] + len(content).to_bytes(4, "big") + content[8:]
    content += b"".join(page + end.to_bytes(4, "big") for end in (*ends[:-1], 0))
    (tmp_path / "a.tif").write_bytes(content)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif", frame=999), 0)
    with pytest.raises(InputError, match=r"declares 8\.39e\+09 bytes"):
        read_frames(tmp_path / "a.tif")


def test_channels_are_no_frames_unless_asked_for(tmp_path):
    path = tmp_path / "a.tif"
    data = np.random.default_rng(1).integers(0, 60000, (2, 8, 9)).astype("u2")
    tifffile.imwrite(path, data, imagej=True, metadata={"axes": "CYX"})
    with pytest.raises(InputError, match="2 channels, not images one after the other"):
        read_frames(path)
    np.testing.assert_array_equal(read_pixels(path, frame=1), data[1])


def test_values_beyond_float64_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0, 2**53 + 1], [1, 2]]))
    with pytest.raises(InputError, match=r"expected whole numbers up to 2\^53"):
        read_pixels(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.array([[0, 1j], [1, 2]]))
    with pytest.raises(InputError, match="complex128; expected real numbers"):
        read_pixels(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("name", "start", "says"),
    [
        ("a.nc", b"CDF\x05", "nccopy -k nc4"),
        ("a.tif.zst", b"\x28\xb5\x2f\xfd", "zstd -d"),
        ("a.tif.gz", b"\x1f\x8b\x08\0", "gunzip"),
        ("a.tif.xz", b"\xfd7zXZ\0", "unxz"),
        ("a.tif.bz2", b"BZh9", "bunzip2"),
    ],
)
def test_sound_files_that_are_not_read_say_how(tmp_path, name, start, says):
    (tmp_path / name).write_bytes(start + bytes(100))
    with pytest.raises(InputError, match="is not read as an image") as stop:
        read_pixels(tmp_path / name)
    assert says in str(stop.value) and "damaged" not in str(stop.value)


def test_a_filter_that_is_not_there_is_named(tmp_path):
    """HDF5 compressed by LZF is read; by one that has no number here, its name is said."""
    h5py = pytest.importorskip("h5py")
    values = np.arange(20.0).reshape(4, 5)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, compression="lzf")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.h5"), values)
    content = (tmp_path / "a.h5").read_bytes().replace(b"lzf\0", b"xyz\0")
    # the number of LZF, 32000, becomes one that is not registered
    (tmp_path / "b.h5").write_bytes(content.replace((32000).to_bytes(2, "little"), b"\xfa\x7d"))
    with pytest.raises(InputError, match=r"compressed by .*32250.*h5repack"):
        read_pixels(tmp_path / "b.h5")


def test_davis_images(tmp_path):
    lvpyio = pytest.importorskip("lvpyio")
    frames = np.random.default_rng(1).integers(0, 4096, (2, 8, 9)).astype("u2")
    lvpyio.write_buffer(lvpyio.arrays_to_buffer(list(frames)), str(tmp_path / "a.im7"))
    np.testing.assert_array_equal(read_frames(tmp_path / "a.im7"), frames)
    (tmp_path / "b.im7").write_bytes(b"no image")
    with pytest.raises(InputError, match="as DaVis image"):
        read_pixels(tmp_path / "b.im7")
