"""Figures as PNG files."""

from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lidar_mi import __version__
from lidar_mi.io.atomic import write_atomically


def write_png(figure: Figure, path: str | Path, *, cropped: bool = False) -> None:
    """Write a figure, 110 dots per inch, whole or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : str or Path
    cropped : bool
        Without the space around the panels except 0.1 inch, which is large with equal scales.
    """
    room: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.1} if cropped else {}
    write_atomically(path, _png(figure, dpi=110, **room))


def png_bytes(figure: Figure) -> bytes:
    """A figure as a small PNG file in memory, 70 dots per inch, cropped."""
    return _png(figure, dpi=70, bbox_inches="tight", pad_inches=0.1)


def _png(figure: Figure, **options: Any) -> bytes:
    buffer = BytesIO()
    software = {"Software": f"lidar-mi {__version__}"}
    figure.savefig(buffer, format="png", metadata=software, **options)
    return buffer.getvalue()
