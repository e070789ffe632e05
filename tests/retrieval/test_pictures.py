"""Pictures from files. Detects a picture turned or mirrored, values scaled, a wrong spacing, and
files that are no grey pictures but are read as such.
"""

import numpy as np
import pytest
from PIL import Image

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images import read_picture


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [("png", np.uint8), ("bmp", np.uint8), ("tif", np.uint8), ("png", np.uint16),
     ("tif", np.uint16), ("tif", np.float32)],
)  # fmt: skip
def test_values_and_axes_survive(tmp_path, suffix, kind):
    values = (np.arange(12).reshape(3, 4) * 20).astype(kind)
    if kind is np.uint16:
        values = values * 250
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(values).save(path)
    image = read_picture(path, 0.5)
    # top left is largest z and largest y
    assert float(image.sel(z=0.5, y=0.75)) == values[0, 0]
    assert float(image.sel(z=-0.5, y=0.25)) == values[2, 1]
    np.testing.assert_array_equal(image.values[::-1, ::-1], values)
    assert image.z.attrs["units"] == image.y.attrs["units"] == "m"


@pytest.mark.parametrize("spacing", [None, 0.0, -1.0, np.nan])
def test_spacing_is_needed(tmp_path, spacing):
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(path)
    with pytest.raises(InputError, match="spacing: .* expected a number above 0"):
        read_picture(path, spacing)


def test_what_is_no_grey_picture_is_named(tmp_path):
    colours, text = tmp_path / "a.png", tmp_path / "b.png"
    Image.fromarray(np.zeros((3, 4, 3), np.uint8)).save(colours)
    text.write_text("no picture")
    with pytest.raises(InputError, match=r"colours \(RGB\)"):
        read_picture(colours, 1.0)
    with pytest.raises(InputError, match="not a readable picture"):
        read_picture(text, 1.0)
    with pytest.raises(InputError, match="no such file"):
        read_picture(tmp_path / "c.tif", 1.0)
