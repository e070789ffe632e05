"""Images and their noise before a retrieval.

Detects: noise that is unknown outside of the images' pixels and refused, or unknown within and
taken for something; one image given twice of which nothing is said, or whose wind counts as valid.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lidar_mi.flags import Flag
from lidar_mi.retrieval.checks import checked_stack, identical
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.series import retrieve_winds
from tests.support.flows import data_array


def test_noise_need_not_be_known_where_there_is_no_image():
    y, z = np.arange(8.0), np.arange(6.0)
    random = np.random.default_rng(1)
    image, noise = 1 + random.random((6, 8)), 0.1 + random.random((6, 8))
    image[:2, :3] = noise[:2, :3] = np.nan
    noise[5, 5] = np.nan
    _, found = checked_stack([data_array(image, y, z)] * 2, data_array(noise, y, z))
    assert (found.values[:2, :3] == np.nanmedian(noise)).all()
    assert np.isnan(found.values[5, 5])
    known = np.isfinite(noise)
    np.testing.assert_array_equal(found.values[known], noise[known])


def test_images_that_are_the_same_are_named():
    one, other = np.array([[1.0, np.nan]]), np.array([[1.0, 2.0]])
    assert identical([one, other, one]) == ""
    assert identical([one, one.copy(), other]) == "images 1 and 2 are the same, bit for bit"
    assert identical([other, one, one], "frames", 0) == ("frames 1 and 2 are the same, bit for bit")
    assert "0 and 1, 1 and 2, 2 and 3 and 6 more pairs" in identical([one] * 10, "frames", 0)
    # the least number above is another image
    assert identical([other, np.nextafter(other, 9)]) == ""


@pytest.mark.slow
@pytest.mark.parametrize("checks", [True, False])
@pytest.mark.parametrize("method", ["cc", "ws", "multipass", "variational", "vortex_fit"])
def test_one_image_given_twice_has_no_valid_wind(method, checks):
    y, z = np.arange(40.0), np.arange(32.0)
    air = 1 + gaussian_filter(np.random.default_rng(1).standard_normal((32, 41)), 1.5)
    image, moved = (data_array(air[:, k : k + 40], y, z) for k in (0, 1))
    wind = retrieve_wind(image, image.copy(), 1.0, method, checks=checks)
    words = "images 1 and 2 are the same, bit for bit"
    assert wind.identical_images == words
    assert bool((wind.flag & Flag.AT_REST.value).all())
    if method == "vortex_fit":
        return
    winds = retrieve_winds([image, image, moved], 1.0, method=method, checks=checks)
    assert [words in str(remark) for remark in winds["remark"].values] == [True, False]
    assert not bool((winds.flag[0] == 0).any())


def test_nor_has_a_burst_with_one_image_twice():
    y, z = np.arange(40.0), np.arange(32.0)
    air = 1 + gaussian_filter(np.random.default_rng(1).standard_normal((32, 41)), 1.5)
    image, moved = (data_array(air[:, k : k + 40], y, z) for k in (0, 1))
    wind = retrieve_wind(image, moved, 1.0, more=[moved])
    assert wind.identical_images == "images 2 and 3 are the same, bit for bit"
    assert not bool((wind.flag == 0).any())
