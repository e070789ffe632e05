"""Frames of an animation: packed for a report, as a GIF file, as a video."""

from collections.abc import Sequence
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically

QUALITY = 55
"""Quality of lossy frames, 0 to 100."""

VIDEO_EXTRA = "a video needs PyAV; expected pip install 'lidar-mi[film]'"
"""Message where PyAV is missing."""

_COLOURS = 128
# Constant rate factor of x264: 23 is its default, higher is smaller.
_RATE_FACTOR = "26"


def frame_as_webp(frame: np.ndarray, quality: int = QUALITY) -> bytes:
    """A frame (height, width, 3), 8 bit, as a lossy WebP image."""
    from PIL import Image

    content = BytesIO()
    Image.fromarray(frame).save(content, "WEBP", quality=quality, method=4)
    return content.getvalue()


def write_gif(path: str | Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """An animation of 8-bit frames (height, width, 3) that repeats, in 128 colours.

    Each is shown for so many seconds; GIF knows hundredths.

    Raises InputError: no frames, frames of several sizes, or as of `write_atomically`.
    """
    from PIL import Image

    if len({frame.shape for frame in frames}) != 1:
        raise InputError(f"{path}: {len(frames)} frames of one size expected")
    # one palette for all frames, so that the background does not flicker; of all colours, not the
    # most frequent ones, so that thin lines keep theirs next to a grey image
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


def as_mp4(frames: Sequence[np.ndarray], seconds: float) -> bytes | None:
    """Frames as an MP4 file (H.264), which browsers and presentations play; None without PyAV.

    frames (height, width, 3): 8 bit, of one size, with even numbers of rows and columns.
    seconds: for which each is shown.

    Raises InputError: no frames, frames of several sizes or of odd ones.
    """
    shapes = {frame.shape for frame in frames}
    if len(shapes) != 1 or any(n % 2 for shape in shapes for n in shape[:2]):
        raise InputError(
            f"video: {len(frames)} frames of sizes {sorted(s[:2] for s in shapes)} are not "
            "allowed; expected one size with even numbers of rows and columns"
        )
    try:
        import av
    except ImportError:
        return None
    content = BytesIO()
    with av.open(content, "w", format="mp4") as file:
        clock = Fraction(seconds).limit_denominator(1000)
        stream = file.add_stream("libx264", rate=1 / clock, options={"crf": _RATE_FACTOR})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode(None))
    return content.getvalue()
