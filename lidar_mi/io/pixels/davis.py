"""Images of LaVision's DaVis: im7 files."""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, frames_of, reading
from lidar_mi.io.size import check_size


def read_davis(path: Path) -> Frames:
    """The frames of a DaVis image, raw counts; masked pixels are NaN.

    Raises InputError: lvpyio is not installed; a damaged file; frames of several planes or
    different sizes.
    """
    try:
        import lvpyio
    except ImportError:
        raise InputError(
            f"{path}: DaVis files need the library lvpyio of LaVision: pip install "
            "'lidar-mi[davis]'; or export TIFF"
        ) from None
    with reading(path, "DaVis image"):
        with path.open("rb") as file:
            width, height, depth, count = struct.unpack("<8x4i", file.read(24))
        if min(width, height, depth, count) < 1:
            raise ValueError(f"{width} x {height} x {depth} x {count} pixels")
        check_size(path, 8 * width * height * depth * count)
        buffer = lvpyio.read_buffer(str(path))
        frames = [_frame(path, frame) for frame in buffer]
    if len({image.shape for image in frames}) != 1:
        raise InputError(f"{path}: no frames, or of different sizes; expected one size")
    return frames_of(path, np.stack(frames))


def _frame(path: Path, frame: Any) -> np.ndarray:
    if "PIXEL" not in frame.components or len(frame.components["PIXEL"].planes) != 1:
        raise InputError(f"{path}: frames of several planes, or vectors; expected images")
    pixels = np.asarray(frame.components["PIXEL"].planes[0])
    masked = np.zeros(pixels.shape, bool)
    if "MASK" in frame.components:
        # there a pixel is 1 where it is valid
        masked = np.asarray(frame.components["MASK"].planes[0]) == 0
    return np.where(masked, np.nan, pixels) if masked.any() else pixels
