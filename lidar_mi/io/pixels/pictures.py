"""Pictures of 8 bits a channel: JPEG, BMP, GIF, WebP; and JPEG 2000."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, frames_of, grey, reading
from lidar_mi.io.size import check_size

if TYPE_CHECKING:
    from PIL import Image

_FORMATS = ("JPEG", "BMP", "GIF", "WEBP")
"""Reading others may execute programs."""
_GREY = {"1": 0, "L": 0, "LA": 1}
"""Modes of one channel, with the number of transparency channels."""


def read_picture(path: Path) -> Frames:
    """All images of a JPEG, BMP, GIF or WebP file, turned as its EXIF orientation says.

    Raises InputError: a damaged file, one that declares too much, inks (CMYK), or images of
    different sizes.
    """
    from PIL import ImageOps

    with reading(path, "JPEG, BMP, GIF or WebP"):
        with _opened(path, _FORMATS) as file:
            count = getattr(file, "n_frames", 1)
            check_size(path, 8 * count * file.width * file.height * 3)
            images: list[np.ndarray] = []
            for number in range(count):
                file.seek(number)
                _refuse_shallow(path, file)
                images.append(_light(path, ImageOps.exif_transpose(file)))
                if images[-1].shape != images[0].shape:
                    raise InputError(f"{path}: images of different sizes; expected one size")
    return frames_of(path, np.stack(images))


def read_jpeg2000(path: Path) -> Frames:
    """The image of a JPEG 2000 file, of whatever depth and sign.

    Raises InputError: a damaged file, one that declares too much, or channels of unknown meaning.
    """
    import imagecodecs

    with reading(path, "JPEG 2000"):
        with _opened(path, ("JPEG2000",)) as file:
            check_size(path, 8 * file.width * file.height * len(file.getbands()))
        pixels = np.atleast_3d(imagecodecs.jpeg2k_decode(path.read_bytes()))
        channels = pixels.shape[-1]
        image = grey(path, pixels, channels if channels < 4 else 3, int(channels == 4))
    return frames_of(path, image[None])


def _opened(path: Path, formats: tuple[str, ...] | None) -> "Image.Image":
    from PIL import Image

    with warnings.catch_warnings():
        # its size is checked once it is known
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path, formats=formats)


def _refuse_shallow(path: Path, file: "Image.Image") -> None:
    """Five or six bits a colour, which the library spreads over 0 to 255."""
    if file.format == "BMP":
        with path.open("rb") as raw:
            head = raw.read(30)
        # the oldest header, of 12 bytes, has no such depth
        if head[14:15] != b"\x0c" and head[28:30] == b"\x10\0":
            raise InputError(f"{path}: BMP of 16 bits a pixel; expected 1, 4, 8, 24 or 32")


def _light(path: Path, image: "Image.Image") -> np.ndarray:
    if image.mode == "CMYK":
        raise InputError(f"{path}: inks (CMYK) are no light; expected grey or red, green and blue")
    if image.mode in _GREY:
        pixels = np.asarray(image)
        return grey(path, pixels.reshape(*pixels.shape[:2], -1), 1, _GREY[image.mode])
    # of palettes and luma, exactly the colours that the file states
    if image.mode not in ("RGB", "RGBA"):
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    return grey(path, np.asarray(image), 3, int(image.mode == "RGBA"))
