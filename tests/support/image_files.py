"""Image files of every kind, made by other programs or byte by byte, with the values they hold.

`made` draws one at random, `check` reads it: the same values, or one line that says what to do. A
file that is cut off gives its values or one line, never other values.
"""

import gzip
import io
import itertools
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.images import frames_in, read_frames, read_pixels

ROWS, COLUMNS = 7, 9
WHOLE = ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8")
FLOATS = ("f2", "f4", "f8")
COMPRESSIONS = ("none", "lzw", "deflate", "packbits", "zstd", "lzma", "png", "jpeg2000", "jpegxl")
OF_16_BITS = ("png", "jpeg2000", "jpegxl")
"""Compressions that are exact up to 16 bits."""
CHANNELS = ("grey", "grey alpha", "colour", "colour alpha", "planes", "planes alpha", "equal")


@dataclass(frozen=True)
class Made:
    """A file.

    Attributes
    ----------
    name : str
    content : bytes
    expected : (frames, height, width) array, float64; or None
        What it holds; None: it must be refused.
    about : str
        How it was made.
    layer : str or None
        The layer that is asked for.
    tolerance : float
        Of lossy compression.
    """

    name: str
    content: bytes
    expected: np.ndarray | None
    about: str
    layer: str | None = None
    tolerance: float = 0.0


class Unwritable(Exception):
    """A combination that the writer does not know."""


def values(rng: np.random.Generator, kind: str, *shape: int) -> np.ndarray:
    """Numbers over all that a type holds and float64 does exactly."""
    dtype = np.dtype(kind)
    if dtype.kind == "f":
        return (rng.standard_normal(shape) * 10.0 ** rng.integers(-2, 4)).astype(dtype)
    if dtype.kind == "b":
        return rng.random(shape) < 0.5
    about = np.iinfo(dtype)
    low, high = max(about.min, -(2**53)), min(about.max, 2**53)
    found = rng.integers(low, high, shape, dtype=np.int64, endpoint=True)
    found.flat[:2] = low, high
    return found.astype(dtype)


def mean(colours: np.ndarray) -> np.ndarray:
    """The mean of red, green and blue along the last axis; exact where they are equal."""
    exact = colours.astype(float)
    middle = exact.sum(-1) / 3
    same = (exact == exact[..., :1]).all(-1)
    return np.where(same, exact[..., 0], middle)


def stored(write: Callable[[str], object], suffix: str) -> bytes:
    """Bytes of a file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        write(str(path))
        return path.read_bytes()


def tiff(
    rng: np.random.Generator,
    kind: str | None = None,
    compression: str | None = None,
    channels: str | None = None,
) -> Made:
    """TIFF or BigTIFF by tifffile, of one or several pages."""
    import tifffile

    kind = kind or str(rng.choice([*WHOLE, *FLOATS]))
    compression = compression or str(rng.choice(COMPRESSIONS))
    if compression in OF_16_BITS and kind not in ("u1", "u2"):
        raise Unwritable(f"{compression} of {kind}")
    channels = channels or str(rng.choice(CHANNELS))
    pages = int(rng.choice([1, 1, 2, 3]))
    options = {
        "byteorder": str(rng.choice(["<", ">"])),
        "bigtiff": bool(rng.integers(2)),
        "rowsperstrip": int(rng.integers(1, ROWS + 1)),
    }
    if compression in OF_16_BITS:
        # the writer would hand swapped bytes to the codec, which has an order of its own
        options["byteorder"] = "<"
    if compression != "none":
        options["compression"] = {"deflate": "adobe_deflate"}.get(compression, compression)
    if compression == "jpeg2000":
        options["compressionargs"] = {"reversible": True, "level": 0}
    if compression == "jpegxl":
        options["compressionargs"] = {"lossless": True}
    if compression in ("lzw", "deflate", "zstd", "lzma") and rng.random() < 0.5:
        options["predictor"] = 3 if kind in FLOATS else 2
    if rng.random() < 0.2:
        options |= {"tile": (16, 16)}
        del options["rowsperstrip"]
    colours = 1 if channels.startswith("grey") else 3
    alpha = int(channels.endswith("alpha"))
    data = values(rng, kind, pages, ROWS, COLUMNS, colours + alpha)
    if channels == "equal":
        data[..., 1:] = data[..., :1]
    options["photometric"] = "minisblack" if colours == 1 else "rgb"
    if alpha:
        options["extrasamples"] = [str(rng.choice(["unassalpha", "assocalpha"]))]
    expected = mean(data[..., :3]) if colours == 3 else data[..., 0].astype(float)
    if channels.startswith("planes"):
        options["planarconfig"] = "separate"
        data = np.moveaxis(data, -1, 1)
    elif data.shape[-1] == 1:
        data = data[..., 0]
    elif colours + alpha > 1:
        options["planarconfig"] = "contig"
    about = f"tiff {kind} {compression} {channels} {pages} {options}"
    buffer = io.BytesIO()
    try:
        byte_order, big = options.pop("byteorder"), options.pop("bigtiff")
        with tifffile.TiffWriter(buffer, byteorder=byte_order, bigtiff=big) as file:
            for page in data:
                file.write(page, contiguous=False, metadata=None, **options)
    except Exception as error:
        raise Unwritable(about) from error
    return Made("a.tif", buffer.getvalue(), expected, about)


def stack(rng: np.random.Generator) -> Made:
    """OME-TIFF, a stack of ImageJ, or pages that tifffile describes."""
    import tifffile

    kind, sort = str(rng.choice(["u1", "u2", "f4"])), str(rng.choice(["ome", "imagej", "shaped"]))
    axes = str(rng.choice(["TYX", "ZYX", "CYX", "TZYX", "ZCYX"]))
    data = values(rng, kind, *rng.integers(2, 4, len(axes) - 2), ROWS, COLUMNS)
    options: dict = {"photometric": "minisblack"}
    if sort == "ome":
        options |= {"ome": True, "metadata": {"axes": axes}}
    elif sort == "imagej":
        options |= {"imagej": True, "metadata": {"axes": axes}}
    expected = data.reshape(-1, ROWS, COLUMNS).astype(float)
    if sort != "shaped" and axes not in ("TYX", "ZYX"):
        expected = None
    if sort == "imagej" and rng.random() < 0.3:
        options["contiguous"] = True
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, data, **options)
    return Made("a.ome.tif", buffer.getvalue(), expected, f"{sort} {axes} {kind} {data.shape}")


def odd_tiff(rng: np.random.Generator) -> Made:
    """White as 0, palettes, orientations, 12 bits a pixel, missing data, channels of no meaning."""
    import tifffile

    sort = str(
        rng.choice(["white", "palette", "ramp", "orientation", "channels", "bits", "nodata"])
    )
    kind = str(rng.choice(["u1", "u2"]))
    data = values(rng, kind, ROWS, COLUMNS)
    expected, options = data.astype(float), {"photometric": "minisblack", "metadata": None}
    if sort == "white":
        options["photometric"], expected = "miniswhite", None
    elif sort in ("palette", "ramp"):
        data = values(rng, "u1", ROWS, COLUMNS)
        ramp = np.arange(256, dtype="u2") * int(rng.choice([256, 257]))
        options["colormap"] = np.stack([ramp, ramp, ramp if sort == "ramp" else ramp[::-1]])
        options["photometric"] = "palette"
        expected = data.astype(float) if sort == "ramp" else None
    elif sort == "orientation":
        number = int(rng.integers(1, 9))
        options["extratags"] = [(274, 3, 1, number, True)]
        turned = expected.T if number > 4 else expected
        turned = turned[::-1] if number in (3, 4, 7, 8) else turned
        expected = turned[:, ::-1] if number in (2, 3, 6, 7) else turned
    elif sort == "channels":
        data, expected = values(rng, kind, ROWS, COLUMNS, 2), None
        options |= {"planarconfig": "contig", "extrasamples": ["unspecified"]}
    elif sort == "nodata":
        missing = int(data[2, 3])
        options["extratags"] = [(42113, 2, 0, str(missing), True)]
        expected = np.where(data == missing, np.nan, expected)
    else:
        bits = int(rng.choice([1, 2, 4, 10, 12, 14]))
        data = rng.integers(0, 2**bits, (ROWS, COLUMNS))
        content = packed_tiff(data, bits)
        return Made("a.tif", content, data[None].astype(float), f"tiff of {bits} bits")
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, data, **options)
    expected = None if expected is None else expected[None]
    return Made("a.tif", buffer.getvalue(), expected, f"tiff {sort} {kind} {options}")


def packed_tiff(data: np.ndarray, bits: int) -> bytes:
    """A grey TIFF, big endian, whose rows are packed and end at full bytes."""
    rows = packed(data, bits)
    tags = {256: data.shape[1], 257: data.shape[0], 258: bits, 259: 1, 262: 1, 277: 1}
    tags |= {278: data.shape[0], 279: len(rows)}
    end = 8 + 2 + 12 * (len(tags) + 1) + 4
    entries = b"".join(
        struct.pack(">HHII", tag, 4, 1, number)
        for tag, number in sorted({**tags, 273: end}.items())
    )
    return struct.pack(">2sHIH", b"MM", 42, 8, len(tags) + 1) + entries + bytes(4) + rows


def packed(data: np.ndarray, bits: int) -> bytes:
    """Rows of numbers of so many bits, each padded to full bytes."""
    places = np.arange(bits)[::-1]
    flat = (data[..., None] >> places & 1).reshape(len(data), -1)
    return np.packbits(flat.astype("u1"), axis=1).tobytes()


def png_bytes(
    data: np.ndarray, depth: int, colour: int, *, interlaced: bool = False, palette: bytes = b""
) -> bytes:
    """A PNG file, byte by byte; data (height, width, channels)."""
    height, width, _ = data.shape
    passes = [(0, 0, 1, 1)]
    if interlaced:
        passes = [
            (0, 0, 8, 8),
            (0, 4, 8, 8),
            (4, 0, 8, 4),
            (0, 2, 4, 4),
            (2, 0, 4, 2),
            (0, 1, 2, 2),
            (1, 0, 2, 1),
        ]
    rows = b""
    for row, column, down, right in passes:
        part = data[row::down, column::right]
        if part.size:
            for line in part:
                rows += b"\0" + packed(line.reshape(1, -1).astype(np.int64), depth)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, int(interlaced)))
    ]
    chunks += [(b"PLTE", palette)] if palette else []
    chunks += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )


def png(rng: np.random.Generator) -> Made:
    """PNG of every depth and type of colour, interlaced or not."""
    colour, depth = [
        *itertools.product((0,), (1, 2, 4, 8, 16)),
        *itertools.product((2, 4, 6), (8, 16)),
        *itertools.product((3,), (1, 2, 4, 8)),
    ][rng.integers(15)]
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    data = rng.integers(0, 2**depth, (ROWS, COLUMNS, channels))
    table = rng.integers(0, 256, (2**depth, 3))
    palette = table.astype("u1").tobytes() if colour == 3 else b""
    interlaced = bool(rng.integers(2))
    content = png_bytes(data, depth, colour, interlaced=interlaced, palette=palette)
    if colour == 3:
        expected = mean(table[data[..., 0]])
    else:
        expected = mean(data[..., :3]) if colour in (2, 6) else data[..., 0].astype(float)
    return Made("a.png", content, expected[None], f"png {colour} {depth} {interlaced}")


def netpbm(rng: np.random.Generator) -> Made:
    """PGM, PPM, PAM and PFM, byte by byte."""
    magic = str(rng.choice(["P1", "P2", "P3", "P4", "P5", "P6", "P7", "Pf", "PF"]))
    size, gap = f"{COLUMNS} {ROWS}", str(rng.choice(["\n", "\n# a comment\n", " "]))
    if magic in ("P1", "P4"):
        bits = rng.integers(0, 2, (ROWS, COLUMNS))
        body = " ".join(map(str, bits.ravel())).encode() if magic == "P1" else packed(bits, 1)
        return Made("a.pbm", f"{magic}\n{size}\n".encode() + body, None, magic)
    if magic in ("Pf", "PF"):
        data = values(rng, "f4", ROWS, COLUMNS, 1 if magic == "Pf" else 3)
        order, scale = [("<f4", "-1.0"), (">f4", "1.0")][rng.integers(2)]
        head = f"{magic}\n{size}\n{scale}\n"
        expected = mean(data) if magic == "PF" else data[..., 0].astype(float)
        content = head.encode() + data[::-1].astype(order).tobytes()
        return Made("a.pfm", content, expected[None], f"{magic} {order}")
    largest = int(rng.choice([1, 100, 255, 256, 1023, 4095, 65535]))
    colours, alpha = (3 if magic in ("P3", "P6") else 1), 0
    if magic == "P7":
        colours, alpha = int(rng.choice([1, 3])), int(rng.integers(2))
    frames = int(rng.choice([1, 1, 2])) if magic in ("P5", "P6", "P7") else 1
    data = rng.integers(0, largest + 1, (frames, ROWS, COLUMNS, colours + alpha))
    content = b""
    for one in data:
        if magic == "P7":
            named = ("GRAYSCALE" if colours == 1 else "RGB") + "_ALPHA" * alpha
            lines = [f"WIDTH {COLUMNS}", f"HEIGHT {ROWS}", f"DEPTH {colours + alpha}"]
            lines += [f"MAXVAL {largest}", f"TUPLTYPE {named}", "ENDHDR", ""]
            content += "\n".join(["P7", *lines]).encode()
        else:
            content += f"{magic}{gap}{size}\n{largest}\n".encode()
        if magic in ("P2", "P3"):
            content += " ".join(map(str, one.ravel())).encode()
        else:
            content += one.astype(">u2" if largest > 255 else "u1").tobytes()
    expected = mean(data[..., :3]) if colours == 3 else data[..., 0].astype(float)
    return Made("a.pnm", content, expected, f"{magic} {largest} {colours} {alpha} {frames}")


def fits(rng: np.random.Generator) -> Made:
    """FITS images and cubes, scaled, with missing pixels, compressed, in gzip, in extensions."""
    from astropy.io import fits as astropy

    sort = str(rng.choice(["plain", "unsigned", "scaled", "blank", "compressed", "two", "named"]))
    shape = (ROWS, COLUMNS) if rng.random() < 0.5 else (2, ROWS, COLUMNS)
    kind = str(rng.choice(["u1", "i2", "i4", "i8", "f4", "f8"]))
    if sort in ("scaled", "blank"):
        kind = str(rng.choice(["u1", "i2", "i4"]))
    if sort == "unsigned":
        kind = str(rng.choice(["i1", "u2", "u4", "u8"]))
    if sort == "compressed":
        kind = str(rng.choice(["u1", "i2", "i4"]))
    data = values(rng, kind, *shape)
    expected, layer, header = data.astype(float), None, astropy.Header()
    if sort in ("scaled", "blank"):
        if sort == "scaled":
            header["BSCALE"], header["BZERO"] = 0.1, -3.25
            expected = expected * 0.1 - 3.25
        else:
            header["BLANK"] = int(data.flat[5])
            expected = np.where(data == data.flat[5], np.nan, expected)
        content = fits_bytes(data, header)
    else:
        primary = astropy.PrimaryHDU(data)
        parts = [primary]
        if sort == "compressed":
            kinds = ["RICE_1", "GZIP_1", "GZIP_2"]
            part = astropy.CompImageHDU(data, compression_type=str(rng.choice(kinds)))
            parts = [astropy.PrimaryHDU(), part]
        elif sort in ("two", "named"):
            other = astropy.ImageHDU(data[..., ::-1].copy(), name="OTHER")
            parts = [astropy.PrimaryHDU(), astropy.ImageHDU(data, name="SCI"), other]
            layer, expected = ("SCI", expected) if sort == "named" else (None, None)
        buffer = io.BytesIO()
        astropy.HDUList(parts).writeto(buffer)
        content = buffer.getvalue()
    name = "a.fits"
    if rng.random() < 0.3:
        content, name = gzip.compress(content), "a.fits.gz"
    if expected is not None:
        expected = expected.reshape(-1, ROWS, COLUMNS)
    return Made(name, content, expected, f"fits {sort} {kind} {shape} {name}", layer)


def fits_bytes(data: np.ndarray, header) -> bytes:
    """A FITS file, byte by byte."""
    bits = 8 * data.dtype.itemsize
    cards = [f"SIMPLE  = {'T':>20}", f"BITPIX  = {bits:>20}", f"NAXIS   = {data.ndim:>20}"]
    cards += [f"NAXIS{n}  = {size:>20}" for n, size in enumerate(data.shape[::-1], 1)]
    cards += [f"{key:8}= {header[key]!r:>20}" for key in header]
    head = "".join(f"{card:80}" for card in (*cards, "END"))
    body = data.astype(data.dtype.newbyteorder(">")).tobytes()
    return b"".join(
        part.ljust(-(-len(part) // 2880) * 2880, fill)
        for part, fill in ((head.encode(), b" "), (body, b"\0"))
    )


def exr(rng: np.random.Generator) -> Made:
    """EXR of half, float and whole numbers, of colours, of one or two parts."""
    import OpenEXR

    kind = str(rng.choice(["f2", "f4", "u4"]))
    sort = str(rng.choice(["grey", "colour", "equal", "alpha", "parts", "part"]))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    data, layer = values(rng, kind, 4, ROWS, COLUMNS), None
    if sort == "equal":
        data[1:] = data[0]
    if sort in ("parts", "part"):
        parts = [OpenEXR.Part(dict(header), {"Y": data[n]}, f"t{n}") for n in range(2)]
        content = stored(lambda path: OpenEXR.File(parts).write(path), ".exr")
        layer, expected = ("t1.Y", data[1].astype(float)) if sort == "part" else (None, None)
    else:
        names = {"grey": "Y", "alpha": "RGBA"}.get(sort, "RGB")
        channels = dict(zip(names, data, strict=False))
        content = stored(lambda path: OpenEXR.File(header, channels).write(path), ".exr")
        expected = data[0].astype(float) if sort == "grey" else mean(np.stack(data[:3], -1))
    expected = None if expected is None else expected[None]
    return Made("a.exr", content, expected, f"exr {sort} {kind}", layer)


def array(rng: np.random.Generator) -> Made:
    """Arrays in npy, npz, MATLAB 5 and 7.3, and HDF5 files."""
    import h5py
    from scipy.io import savemat

    sort = str(rng.choice(["npy", "npz", "mat", "mat73", "h5"]))
    kind = str(rng.choice([*WHOLE, *FLOATS, "?"]))
    if sort.startswith("mat") and kind in ("f2", "?"):
        kind = "f4"
    shape = str(rng.choice(["image", "cube", "colours", "two", "named"]))
    size = {"cube": (3, ROWS, COLUMNS), "colours": (ROWS, COLUMNS, 3)}.get(shape, (ROWS, COLUMNS))
    data = values(rng, kind, *size)
    named = {"frame": data, "gain": np.ones(3)}
    if shape in ("two", "named") and sort != "npy":
        named["dark"] = np.zeros((ROWS, COLUMNS))
    layer = "frame" if shape == "named" and sort != "npy" else None
    buffer = io.BytesIO()
    if sort == "npy":
        order = rng.choice(["C", "F"])
        np.save(buffer, np.asarray(data, data.dtype.newbyteorder(rng.choice(["<", ">"])), order))
    elif sort == "npz":
        (np.savez_compressed if rng.integers(2) else np.savez)(buffer, **named)
    elif sort == "mat":
        savemat(buffer, named, do_compression=bool(rng.integers(2)))
    else:
        with h5py.File(buffer, "w", userblock_size=512 if sort == "mat73" else 0) as file:
            for name, values_ in named.items():
                packing = {"compression": "gzip", "shuffle": True} if rng.integers(2) else {}
                one = file.create_dataset(
                    name, data=values_.T if sort == "mat73" else values_, **packing
                )
                if sort == "mat73":
                    one.attrs["MATLAB_class"] = np.bytes_("double")
    content = buffer.getvalue()
    if sort == "mat73":
        content = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + content[512:]
    expected = data.reshape(-1, *size[-2:]).astype(float)
    refused = shape == "colours" or (shape == "two" and sort != "npy")
    if refused or (shape == "cube" and sort.startswith("mat")):
        expected = None
    suffix = {"mat73": "mat"}.get(sort, sort)
    return Made(f"a.{suffix}", content, expected, f"{sort} {shape} {kind}", layer)


def picture(rng: np.random.Generator) -> Made:
    """BMP, GIF, WebP, JPEG, JPEG 2000 by Pillow and imagecodecs."""
    import imagecodecs
    from PIL import Image

    sort = str(rng.choice(["bmp", "gif", "webp", "jpg", "jp2"]))
    mode = str(rng.choice(["L", "RGB", "RGBA", "P", "CMYK"]))
    if sort == "jp2":
        kind, colours = str(rng.choice(["u1", "u2"])), int(rng.choice([1, 3, 4]))
        data = values(rng, kind, ROWS, COLUMNS, colours)
        content = imagecodecs.jpeg2k_encode(data.squeeze(), level=0, reversible=True)
        expected = mean(data[..., :3]) if colours > 1 else data[..., 0].astype(float)
        return Made("a.jp2", content, expected[None], f"jp2 {kind} {colours}")
    smooth = np.add.outer(np.arange(ROWS), np.arange(COLUMNS)) * 8
    grey = rng.integers(0, 256, (ROWS, COLUMNS)) if sort != "jpg" else smooth + 20
    image = Image.fromarray(grey.astype("u1"))
    expected = grey.astype(float)
    if mode in ("RGB", "RGBA") and sort in ("bmp", "webp", "jpg"):
        colours = rng.integers(0, 256, (ROWS, COLUMNS, 3)) if sort != "jpg" else None
        if colours is None:
            colours = np.stack([smooth, 200 - smooth, smooth + 40], -1)
        image, expected = Image.fromarray(colours.astype("u1")), mean(colours)
        if mode == "RGBA" and sort != "jpg":
            image.putalpha(Image.fromarray(rng.integers(0, 256, grey.shape).astype("u1")))
    elif mode == "P" and sort in ("bmp", "gif"):
        table = rng.integers(0, 256, (256, 3))
        image.putpalette(table.astype("u1").tobytes())
        expected = mean(table[grey])
    elif mode == "CMYK" and sort == "jpg":
        image, expected = image.convert("CMYK"), None
    options = {"webp": {"lossless": True, "exact": True}, "jpg": {"quality": 100, "subsampling": 0}}
    buffer = io.BytesIO()
    image.save(buffer, {"jpg": "JPEG"}.get(sort, sort.upper()), **options.get(sort, {}))
    expected = None if expected is None else expected[None]
    tolerance = 3.0 if sort == "jpg" else 0.0
    return Made(
        f"a.{sort}", buffer.getvalue(), expected, f"{sort} {image.mode}", tolerance=tolerance
    )


SORTS: dict[str, Callable[[np.random.Generator], Made]] = {
    "tiff": tiff,
    "stack": stack,
    "odd tiff": odd_tiff,
    "png": png,
    "netpbm": netpbm,
    "fits": fits,
    "exr": exr,
    "array": array,
    "picture": picture,
}
"""Sorts of files, and what draws one."""


def made(rng: np.random.Generator, sort: str | None = None) -> Made:
    """A file of some sort."""
    while True:
        try:
            return SORTS[sort or str(rng.choice(sorted(SORTS)))](rng)
        except Unwritable:
            continue


def fault(file: Made, *, cut: bool = False) -> str | None:
    """What reading a file breaks; None: nothing. Of a file that is cut off, a line is right too."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, file.name)
        path.write_bytes(file.content)
        try:
            count, channels = frames_in(path, file.layer)
            numbers = range(count) if channels else None
            found = read_frames(path, file.layer, numbers)
            one = read_pixels(path, file.layer, 0)
        except InputError as error:
            if "\n" in str(error) or str(path) not in str(error):
                return f"{file.about}: says {str(error)!r}"
            return None if cut or file.expected is None else f"{file.about}: {error}"
        except Exception as error:
            return f"{file.about}: {type(error).__name__}: {error}"
    if file.expected is None:
        # what made it ambiguous may be cut off
        return None if channels or cut else f"{file.about}: read, and should be refused"
    if found.shape != file.expected.shape:
        return f"{file.about}: {found.shape}, expected {file.expected.shape}"
    for image in (found.astype(float), one[None]):
        with np.errstate(invalid="ignore"):
            wanted = file.expected[: len(image)]
            off = np.abs(image - wanted)
            off[(image == wanted) | (np.isnan(image) & np.isnan(wanted))] = 0
        # a mean of three has a rounding of its own
        limit = file.tolerance + 4e-16 * np.nan_to_num(np.abs(wanted), posinf=0)
        if not (off <= limit).all():
            return f"{file.about}: {np.count_nonzero(~(off <= limit))} values differ"
    return None


def check(seed: int) -> str | None:
    """What breaks with the file of a seed, whole or cut off; None: nothing."""
    rng = np.random.default_rng(seed)
    file = made(rng)
    whole = fault(file)
    if whole is not None:
        return f"seed {seed}: {whole}"
    if file.content[:2] in (b"P2", b"P3"):
        return None  # of a number in text, the first digits are a number as well
    length = int(rng.integers(0, len(file.content)))
    part = Made(
        file.name,
        file.content[:length],
        file.expected,
        f"{file.about}, {length} of {len(file.content)} bytes",
        file.layer,
        file.tolerance,
    )
    cut = fault(part, cut=True)
    return None if cut is None else f"seed {seed}: {cut}"
