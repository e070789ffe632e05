"""Figures as files: unit tests. Detect a figure that is not whole, and a margin that is not cut."""

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from lidar_mi.io.png import write_png


def test_figures_are_written_whole_and_cropped_on_request(tmp_path):
    figure = Figure(figsize=(4, 3))
    figure.add_axes((0.4, 0.4, 0.2, 0.2)).imshow(np.eye(3))
    write_png(figure, tmp_path / "whole.png")
    write_png(figure, tmp_path / "cut.png", cropped=True)
    sizes = {}
    for name in ("whole", "cut"):
        with Image.open(tmp_path / f"{name}.png") as image:
            image.load()
            sizes[name] = image.size
    assert sizes["whole"] == (440, 330)
    assert sizes["cut"][0] < 220 and sizes["cut"][1] < 165
    assert len(list(tmp_path.iterdir())) == 2
