"""Frames of an animation: packed for a report, and as a GIF file."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically

QUALITY = 55
"""Of lossy frames, 0 to 100."""

_COLOURS = 128


def frame_as_webp(frame: np.ndarray, quality: int = QUALITY) -> bytes:
    """A frame (height, width, 3), 8 bit, as a lossy WebP image."""
    from PIL import Image

    content = BytesIO()
    Image.fromarray(frame).save(content, "WEBP", quality=quality, method=4)
    return content.getvalue()


def write_gif(path: str | Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """An animation that repeats, in 128 colours.

    Parameters
    ----------
    path : str or Path
    frames : sequence of ndarray, shape (height, width, 3)
        8 bit, of one size.
    seconds : float
        For which each is shown; GIF knows hundredths.

    Raises
    ------
    InputError
        No frames, frames of several sizes, or as of `write_atomically`.
    """
    from PIL import Image

    if len({frame.shape for frame in frames}) != 1:
        raise InputError(f"{path}: {len(frames)} frames of one size expected")
    # one palette for all, so that what rests does not flicker; of all colours, not of the most
    # frequent, so that thin lines keep theirs next to a grey image
    palette = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 4)])).quantize(
        _COLOURS, Image.Quantize.MAXCOVERAGE
    )
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    content = BytesIO()
    images[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=round(1000 * seconds),
        loop=0,
        optimize=False,
    )
    write_atomically(path, content.getvalue())
