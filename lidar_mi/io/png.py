"""Figures and previews of images as PNG files."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidar_mi import __version__
from lidar_mi.io.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_png(figure: "Figure", path: str | Path, *, cropped: bool = False) -> None:
    """Write a figure, 110 dots per inch, whole or not at all.

    cropped: without the space around the panels except 0.1 inch, which is large with equal scales.
    """
    room: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.1} if cropped else {}
    write_atomically(path, _png(figure, dpi=110, **room))


def png_bytes(figure: "Figure") -> bytes:
    """A figure as a small PNG file in memory, 70 dots per inch, cropped."""
    return _png(figure, dpi=70, bbox_inches="tight", pad_inches=0.1)


def write_preview(path: str | Path, pixels: np.ndarray) -> tuple[float, float]:
    """Write an image of light (top row first) as 8-bit grey, for viewers that know no EXR.

    Grey is linear between black, the value below which 0.5 % of the pixels are, and white, which
    0.5 % exceed, so that faint contrasts are visible. An image of one value is grey. Values that
    are not finite are black. Black and white, in the image's units, are returned.
    """
    from PIL import Image

    light = np.asarray(pixels, float)
    valid = np.isfinite(light)
    black, white = np.quantile(light[valid], (0.005, 0.995)) if valid.any() else (0.0, 0.0)
    spread = white - black
    grey = (light - black) / spread if spread > 0 else np.where(light > black, 1.0, 0.5)
    grey = np.clip(np.where(valid, grey, 0.0), 0, 1)
    buffer = BytesIO()
    Image.fromarray((255 * grey + 0.5).astype(np.uint8)).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())
    return float(black), float(white)


def _png(figure: "Figure", **options: Any) -> bytes:
    buffer = BytesIO()
    software = {"Software": f"lidar-mi {__version__}"}
    figure.savefig(buffer, format="png", metadata=software, **options)
    return buffer.getvalue()
