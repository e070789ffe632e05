"""PGM, PPM, PAM and PFM files: values as stored, of 8 and 16 bits and floats."""

import math
import re
from pathlib import Path
from typing import NoReturn

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, frames_of, grey, reading
from lidar_mi.io.size import check_size

# white space and comments between the words of a header
_GAP = rb"(?:\s|#[^\n\r]*[\n\r])"
_WORD = re.compile(_GAP + rb"*([^\s#]+)")
_COLOURS = {b"P2": 1, b"P3": 3, b"P5": 1, b"P6": 3, b"Pf": 1, b"PF": 3}
_LONGEST = 4096
"""Most bytes of a header."""
_KIND = "PGM, PPM, PAM or PFM"


def read_netpbm(path: Path) -> Frames:
    """All images of a file; float images, stored from the bottom row, are turned.

    Raises InputError: a bitmap (P1, P4), a damaged file, images of different sizes, channels of
    unknown meaning.
    """
    content, place = path.read_bytes(), 0
    images: list[np.ndarray] = []
    if content[:2] in (b"P1", b"P4"):
        raise InputError(f"{path}: black and white (PBM) is no measured light; expected PGM or PPM")
    with reading(path, _KIND):
        while content[place:].strip(b"\0 \n\r\t"):
            image, place = _image(path, content, place)
            if images and image.shape != images[0].shape:
                raise InputError(f"{path}: images of different sizes; expected one size")
            images.append(image)
            if content[:2] in (b"P2", b"P3"):
                break
    return frames_of(path, np.stack(images))


def _image(path: Path, content: bytes, place: int) -> tuple[np.ndarray, int]:
    magic = content[place : place + 2]
    colours, more, width, height, largest, start = (
        _pam_header(path, content, place) if magic == b"P7" else _header(content, place, magic)
    )
    channels = colours + more
    if width < 1 or height < 1:
        raise ValueError(f"{width} x {height} pixels")
    floats = magic in (b"Pf", b"PF")
    if not floats and not 1 <= largest < 65536:
        raise ValueError(f"a largest value of {largest:g}")
    size = width * height * channels
    check_size(path, 8 * size)
    if magic in (b"P2", b"P3"):
        words = re.sub(rb"#[^\n\r]*", b"", content[start:]).split()
        if len(words) != size:
            raise ValueError(f"{len(words)} values of {size}")
        pixels, end = np.array([int(word) for word in words], np.int64), len(content)
    else:
        big = not floats or largest > 0
        stored = "f4" if floats else ("u2" if largest > 255 else "u1")
        kind = np.dtype(stored).newbyteorder(">" if big else "<")
        end = start + size * kind.itemsize
        if end > len(content):
            raise ValueError(f"{len(content) - start} bytes of {end - start}")
        pixels = np.frombuffer(content, kind, size, start)
    if not floats and pixels.max() > largest:
        raise ValueError(f"values above the largest, {largest:g}")
    image = grey(path, pixels.reshape(height, width, channels), colours, more)
    return (image[::-1] if floats else image), end


def _header(content: bytes, place: int, magic: bytes) -> tuple[int, int, int, int, float, int]:
    """Colours, transparency, width, height, largest value or scale, and where pixels begin."""
    text, end, words = content[place : place + _LONGEST], 2, []
    colours = _COLOURS[magic] if magic in _COLOURS else _unknown(magic)
    for _ in range(3):
        word = _WORD.match(text, end)
        if word is None:
            raise ValueError("its header is cut off")
        words.append(word[1])
        end = word.end()
    scale = float(words[2])
    if not math.isfinite(scale) or scale == 0:
        raise ValueError(f"a scale of {scale:g}")
    if magic in (b"Pf", b"PF") and abs(scale) != 1:
        raise ValueError(f"a scale of {scale:g}, whose use is not agreed; expected 1 or -1")
    # one white space follows
    return colours, 0, int(words[0]), int(words[1]), scale, place + end + 1


def _pam_header(path: Path, content: bytes, place: int) -> tuple[int, int, int, int, float, int]:
    text = content[place : place + _LONGEST]
    end = text.index(b"ENDHDR\n") + len(b"ENDHDR\n")
    lines = [line.split(b"#")[0].split() for line in text[:end].splitlines()[1:-1]]
    fields = {line[0]: b" ".join(line[1:]) for line in lines if line}
    tuples = {
        b"GRAYSCALE": (1, 0),
        b"GRAYSCALE_ALPHA": (1, 1),
        b"RGB": (3, 0),
        b"RGB_ALPHA": (3, 1),
    }
    numbers = [int(fields.get(name, b"0")) for name in (b"WIDTH", b"HEIGHT", b"MAXVAL", b"DEPTH")]
    width, height, largest, depth = numbers
    kind = fields.get(b"TUPLTYPE", b"GRAYSCALE" if depth == 1 else b"")
    if kind not in tuples or sum(tuples[kind]) != depth:
        raise InputError(
            f"{path}: {depth} channels of TUPLTYPE {kind.decode(errors='replace')[:20]!r}; "
            f"expected {', '.join(name.decode() for name in tuples)}"
        )
    return *tuples[kind], width, height, largest, place + end


def _unknown(magic: bytes) -> NoReturn:
    raise ValueError(f"it goes on with {magic[:2]!r}")
