"""Kinds of image files, by how they begin."""

import gzip
import zlib
from contextlib import suppress
from pathlib import Path

from lidar_mi.errors import InputError
from lidar_mi.io.compression import compression

KINDS = (
    "image (EXR, PNG, TIFF, BMP, JPEG, FITS, npy, npz, mat, HDF5, JPEG 2000, GIF, WebP, PGM, PPM, "
    "PAM, PFM, im7)"
)
"""Readable kinds, for messages."""

_STARTS = (
    (b"\x76\x2f\x31\x01", "exr"),
    (b"\x89PNG\r\n\x1a\n", "png"),
    *((start, "tiff") for start in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    (b"SIMPLE", "fits"),
    (b"\xff\xd8\xff", "picture"),
    (b"BM", "picture"),
    (b"GIF8", "picture"),
    (b"\0\0\0\x0cjP  ", "jpeg2000"),
    (b"\xff\x4f\xff\x51", "jpeg2000"),
    (b"\x93NUMPY", "npy"),
    (b"PK\x03\x04", "npz"),
    (b"MATLAB 5.0", "mat"),
    *((start + end, "netpbm") for start in (b"P7", b"PF", b"Pf") for end in (b"\n", b" ", b"\r")),
    *((b"P%d%c" % (n, end), "netpbm") for n in range(1, 7) for end in b"\n \r\t#"),
)
_HDF5 = b"\x89HDF\r\n\x1a\n"
_DAVIS = ".im7"


def kind_of(path: Path) -> str:
    """Name of the kind of an image file.

    The content decides; the suffix does only for DaVis and MATLAB 4 files, which have no mark.

    Raises InputError: no such file, one that cannot be opened, or of a kind that is not read.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a file: an {KINDS}")
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an {KINDS}")
    try:
        with path.open("rb") as file:
            start = file.read(1024)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); expected an {KINDS}"
        ) from None
    for mark, kind in _STARTS:
        if start.startswith(mark):
            return kind
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "picture"
    # before HDF5 there may be a block of 512 bytes, which in a MATLAB 7.3 file says so
    if _HDF5 in (start[:8], start[512:520]):
        return "hdf5"
    if path.suffix.lower() == ".exr":
        return "exr"  # its reader says what is wrong
    if path.suffix.lower() == _DAVIS:
        return "davis"
    if path.suffix.lower() == ".mat" and start[:1] in b"\0\x01\x02\x03":
        return "mat"
    if start[:2] == b"\x1f\x8b":
        with suppress(OSError, EOFError, zlib.error), gzip.open(path) as file:
            if file.read(6) == b"SIMPLE":
                return "fits"
    kind_name = how = ""
    if start[:3] == b"CDF":
        kind_name, how = "NetCDF-3", "nccopy -k nc4 FILE NEW.nc"
    elif packed := compression(start):
        name, program = packed
        kind_name, how = f"compressed with {name}", f"{program} FILE"
    if kind_name:
        raise InputError(f"{path}: {kind_name} is not read as an image; expected an {KINDS}: {how}")
    raise InputError(f"{path}: no readable image (it begins as none); expected an {KINDS}")
