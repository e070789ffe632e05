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
    """Rows as given, linear from the 0.5 % quantile to the 99.5 %; NaN is black."""
    light = np.ones((20, 10))
    light[0], light[1], light[2, 0] = 0.0, 0.5, np.nan
    assert write_preview(tmp_path / "a.png", 1e-6 * light) == (0.0, 1e-6)
    grey = _pixels(tmp_path / "a.png")
    assert grey.shape == (20, 10) and grey.dtype == np.uint8
    assert (grey[0] == 0).all() and (grey[3:] == 255).all() and grey[2, 0] == 0
    assert (grey[1] == 128).all()


def test_a_preview_shows_faint_contrast(tmp_path):
    """2 % more light on one half of a bright image: black against white; none at all: grey."""
    light = np.full((20, 10), 3e-8)
    light[:, 5:] *= 1.02
    write_preview(tmp_path / "faint.png", light)
    grey = _pixels(tmp_path / "faint.png")
    assert (grey[:, :5] == 0).all() and (grey[:, 5:] == 255).all()
    for name, value in (("none", 0.0), ("one", 3e-8), ("nan", np.nan)):
        write_preview(tmp_path / f"{name}.png", np.full((3, 4), value))
    assert (_pixels(tmp_path / "one.png") == 128).all()
    assert (_pixels(tmp_path / "nan.png") == 0).all()


def _pixels(path):
    with Image.open(path) as image:
        return np.asarray(image)
