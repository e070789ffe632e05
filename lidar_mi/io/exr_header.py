"""Size declared by an OpenEXR file, from its header alone."""

import struct
from pathlib import Path

_MAGIC = b"\x76\x2f\x31\x01"
_DEEP, _PARTS = 0x800, 0x1000
_LONGEST = 64 << 20
# bytes of a value by the type of its channel: uint, half, float
_BYTES = {0: 4, 1: 2, 2: 4}


def declared(path: Path) -> tuple[int, int]:
    """Bytes of all pixels of all parts, and the number of parts.

    Raises ValueError: not the header of an OpenEXR image of flat, fully sampled channels; with the
    reason.
    """
    with path.open("rb") as file:
        content = file.read(min(_LONGEST, path.stat().st_size))
    try:
        return _declared(content)
    except (struct.error, IndexError, KeyError):
        raise ValueError("its header is cut off or damaged") from None


def _declared(content: bytes) -> tuple[int, int]:
    if content[:4] != _MAGIC:
        raise ValueError("it does not begin as one")
    (flags,) = struct.unpack_from("<I", content, 4)
    if flags & _DEEP:
        raise ValueError("deep pixels")
    place, total, parts = 8, 0, 0
    while True:
        attributes, place = _attributes(content, place)
        if not attributes:  # an empty header ends those of several parts
            return total, parts
        low_x, low_y, high_x, high_y = struct.unpack("<4i", attributes[b"dataWindow"])
        width, height = high_x - low_x + 1, high_y - low_y + 1
        if width < 1 or height < 1:
            raise ValueError(f"{width} x {height} pixels")
        total += width * height * _bytes_of_pixel(attributes[b"channels"])
        parts += 1
        if not flags & _PARTS:
            return total, parts


def _attributes(content: bytes, place: int) -> tuple[dict[bytes, bytes], int]:
    """Attributes of one header by name, and where it ends."""
    attributes = {}
    while content[place]:
        name, place = _text(content, place)
        _, place = _text(content, place)
        (size,) = struct.unpack_from("<i", content, place)
        place += 4
        if not 0 <= size <= len(content) - place:
            raise IndexError
        attributes[name] = content[place : place + size]
        place += size
    return attributes, place + 1


def _bytes_of_pixel(channels: bytes) -> int:
    total, place = 0, 0
    while channels[place]:
        _, place = _text(channels, place)
        kind, _, *sampling = struct.unpack_from("<iI2i", channels, place)
        if sampling != [1, 1]:
            raise ValueError(f"a channel sampled every {' x '.join(map(str, sampling))} pixels")
        total += _BYTES[kind]
        place += 16
    return total


def _text(content: bytes, place: int) -> tuple[bytes, int]:
    end = content.find(b"\0", place)
    if end < 0:
        raise IndexError
    return content[place:end], end + 1
