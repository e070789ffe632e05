"""Figures as files: unit tests. Detect a figure that is not whole, and a margin that is not cut."""

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from lidar_mi.io.png import write_png, write_preview


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


def test_a_preview_has_the_order_of_the_light(tmp_path):
    """Rows as given, black at 0, half of the light at the display's 73 %; NaN is black."""
    light = np.ones((20, 10))
    light[0], light[1], light[2, 0] = 0.0, 0.5, np.nan
    write_preview(tmp_path / "a.png", 1e-6 * light)
    with Image.open(tmp_path / "a.png") as image:
        grey = np.asarray(image)
    assert grey.shape == (20, 10) and grey.dtype == np.uint8
    assert (grey[0] == 0).all() and (grey[3:] == 255).all() and grey[2, 0] == 0
    assert (grey[1] == round(255 * 0.5 ** (1 / 2.2))).all()
    write_preview(tmp_path / "dark.png", 0 * light)
