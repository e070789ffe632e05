"""Figures of the validation page: small, alike, and the same bytes from the same numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt

DOTS_PER_INCH = 90
REFERENCE, OURS, OTHER = "0.25", "tab:blue", "tab:orange"


@contextmanager
def figure(path: Path, size=(7.0, 3.2), rows: int = 1, columns: int = 1, **options) -> Iterator:
    """Axes to draw on; the PNG is written when the block is left."""
    drawn, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", **options)
    try:
        yield axes
        for axis in np.ravel(axes):
            axis.spines[["top", "right"]].set_visible(False)
        path.parent.mkdir(parents=True, exist_ok=True)
        # no version and no date in the file: it changes when its numbers do
        drawn.savefig(path, dpi=DOTS_PER_INCH, metadata={"Software": None})
    finally:
        plt.close(drawn)
