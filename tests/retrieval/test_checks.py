"""Images and their noise before a retrieval.

Detects: noise that is unknown outside of the images' pixels and refused, or unknown within and
taken for something.
"""

import numpy as np

from lidar_mi.retrieval.checks import checked_stack
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
