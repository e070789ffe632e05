"""PNG: every depth, colours and palettes, by libpng."""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, damaged, frames_of, grey
from lidar_mi.io.size import check_size

_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}
"""Channels by the format's colour type, including transparency."""


def read_png(path: Path) -> Frames:
    """The image of a PNG file; grey of 1, 2 and 4 bits is 0 to 1, 3 and 15.

    Raises InputError: a damaged file, one that declares too much, or an animation.
    """
    import imagecodecs

    content = path.read_bytes()
    try:
        width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    except struct.error as error:
        raise damaged(path, "PNG", error) from None
    check_size(path, 8 * width * height * _CHANNELS.get(colour, 4))
    if 0 <= content.find(b"acTL") < content.find(b"IDAT"):
        raise InputError(f"{path}: an animation; expected one image, or the pages of a TIFF file")
    try:
        with _silent() if interlaced else nullcontext():
            pixels = imagecodecs.png_decode(content)
    except Exception as error:  # any exception of the library in a damaged file
        raise damaged(path, "PNG", error) from None
    pixels = pixels.reshape(height, width, -1)
    image = grey(path, pixels, 1 if colour in (0, 4) else 3, 1 - pixels.shape[-1] % 2)
    if colour == 0 and depth < 8:
        # the library spreads them over 0 to 255
        image = image // np.uint8(255 // (2**depth - 1))
    return frames_of(path, image[None])


@contextmanager
def _silent() -> Iterator[None]:
    """Without what libpng writes to the process's standard error: a remark on interlaced files."""
    try:
        former = os.dup(2)
    except OSError:  # no descriptor of standard error
        yield
        return
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(former, 2)
        os.close(former)
        os.close(nothing)
