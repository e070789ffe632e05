"""Which images of rings may be analysed: unit tests. Detect a saturated or broken exposure that is
let through, and a good one that is refused."""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.frames import checked, inside


def crest(height, shape=(120, 160), width=30.0):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return height * np.exp(-((x - 80.3) ** 2 + (y - 60.1) ** 2) / (2 * width**2)) + 3


def test_one_image_is_a_batch_of_floats():
    grey = crest(200).round().astype(np.uint8)
    batch = checked(grey)
    assert batch.shape == (1, 120, 160) and batch.is_floating_point()
    np.testing.assert_array_equal(batch[0], grey)
    double = torch.as_tensor(np.array([crest(9), crest(8)]))
    assert checked(double) is double


@pytest.mark.parametrize("height", [20, 60, 200, 3000])
@pytest.mark.parametrize("width", [10.0, 30.0, 60.0])
def test_a_smooth_crest_in_whole_numbers_is_not_saturated(height, width):
    checked(crest(height, width=width).round())


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_a_clipped_crest_is_saturated(level):
    image = crest(200).round().clip(max=round(200 * level))
    with pytest.raises(InputError, match=r"images\[1\]: saturated, \d+ pixels share the highest"):
        checked(np.array([crest(200).round(), image]))


def test_even_light_is_left_to_those_who_look_for_rings():
    checked(np.full((40, 40), 7.0))


def test_a_known_end_of_the_scale():
    image = crest(200)
    checked(image, saturation=image.max() + 1)
    with pytest.raises(InputError, match=r"saturated, 1 pixel\(s\) at or above"):
        checked(image, saturation=image.max())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none(value):
    image = crest(200)
    image[3, 5] = image[7, 7] = value
    with pytest.raises(InputError, match=r"images\[0\]: 2 pixel\(s\) of NaN or infinity"):
        checked(image)


@pytest.mark.parametrize("shape", [(40,), (15, 40), (0, 40, 40), (2, 3, 40, 40)])
def test_shapes_that_are_no_images(shape):
    with pytest.raises(InputError, match="images: shape"):
        checked(np.ones(shape))


def test_inside_reaches_to_the_edges_of_the_pixels():
    for x, y in ((-0.5, -0.5), (29.5, 19.5), (7.0, 3.0)):
        inside(x, y, (20, 30))
    for x, y in ((-0.6, 3.0), (29.6, 3.0), (7.0, -0.6), (7.0, 19.6), (np.nan, 3.0)):
        with pytest.raises(InputError, match=r"start: .* expected inside the image of 30 x 20 px"):
            inside(x, y, (20, 30), "start")
