"""The result of every reader of pixels: the images of a file, one number a pixel."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError

_EXACT = 2**53
"""Largest whole number up to which all are exact in float64."""
_ALPHA = 1


@dataclass(frozen=True)
class Frames:
    """The images of a file, read when they are asked for.

    read: images of the given numbers, (n, height, width), top row first, in the file's type.
    channels: they are channels of one moment by what the file says, not images one after the other.
    """

    count: int
    read: Callable[[Sequence[int]], np.ndarray]
    channels: bool = False


def frames_of(path: str | Path, images: np.ndarray) -> Frames:
    """Images (n, height, width) that are in memory."""
    exact = checked(path, images)
    return Frames(len(images), lambda numbers: exact[list(numbers)])


def checked(path: str | Path, pixels: np.ndarray) -> np.ndarray:
    """Pixels, if float64 holds every one of them exactly.

    Raises InputError: no real numbers, no pixels, whole numbers beyond 2^53 or floats of more than
    64 bits.
    """
    if pixels.dtype.kind not in "biuf" or pixels.dtype.itemsize > 8:
        raise InputError(f"{path}: pixels of type {pixels.dtype}; expected real numbers of 64 bits")
    if not pixels.size:
        shape = " x ".join(map(str, pixels.shape))
        raise InputError(f"{path}: no pixels ({shape}); expected an image")
    if pixels.dtype.kind in "iu" and pixels.dtype.itemsize == 8:
        low, high = int(pixels.min()), int(pixels.max())
        if max(high, -low) > _EXACT:
            raise InputError(
                f"{path}: values from {low} to {high}; expected whole numbers up to 2^53, which "
                "float64 holds exactly"
            )
    return pixels


def grey(path: str | Path, pixels: np.ndarray, colours: int, more: int = 0) -> np.ndarray:
    """One number a pixel: the mean of red, green and blue; transparency is ignored.

    Nothing is weighted and no gamma is undone. Where the three are equal, the number is theirs.

    pixels (..., height, width, channels)
    colours: 1 or 3, the first of the channels.
    more: channels of transparency that follow: 0 or 1.

    Raises InputError: another number of channels: which of them is light is not known.
    """
    channels = pixels.shape[-1]
    if colours not in (1, 3) or channels != colours + more or more > _ALPHA:
        raise InputError(
            f"{path}: {channels} channels whose meaning is not stated; expected grey or red, "
            "green and blue, with or without transparency"
        )
    pixels = checked(path, pixels[..., :colours])
    first = pixels[..., 0]
    if colours == 1:
        return first
    equal = (pixels == first[..., None]).all(-1)
    if equal.all():
        return first
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(equal, first, pixels.mean(-1, dtype=float))


@contextmanager
def reading(path: str | Path, kind: str) -> Iterator[None]:
    """Turn any exception of a library in a damaged file into `damaged`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise damaged(path, kind, error) from None


def damaged(path: str | Path, kind: str, error: object) -> InputError:
    """The error for a file that its library cannot read."""
    reason = " ".join(str(error).split())[:120]
    return InputError(f"{path}: no readable image, as {kind} ({reason})")
