"""Keywords of version 0.1 give the winds of the options that the warning names.

Detects an old keyword or a position that is lost, and a warning that does not say what to write.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.series import retrieve_winds
from lidar_mi.retrieval.wind.volume import retrieve_wind_volume
from tests.support import volumes
from tests.support.crosswind import DT, crosswind_pair
from tests.support.flows import axes, data_array

SIZE = 48, 40


@pytest.fixture(scope="module")
def pair():
    images, _ = crosswind_pair(1, size=SIZE, mean=(6.0, 2.0))
    return [data_array(image, *axes(*SIZE)) for image in images]


@pytest.fixture(scope="module")
def expected(pair):
    windows, validation = WindowSizes(6, 14, 4), VectorValidation(0.6, median_size=5)
    return retrieve_wind(*pair, DT, "cc", windows=windows, validation=validation)


def test_keywords(pair, expected):
    words = r"write windows=lm.WindowSizes\(template=6, search=14, stride=4\)"
    with (
        pytest.warns(DeprecationWarning, match=words),
        pytest.warns(DeprecationWarning, match=r"VectorValidation\(min_correlation=0.6, median"),
    ):
        found = retrieve_wind(
            *pair, DT, "cc", template=6, search=14, stride=4, min_correlation=0.6, median_size=5
        )
    xr.testing.assert_identical(found, expected)


def test_positions(pair, expected):
    with pytest.warns(DeprecationWarning) as said:
        found = retrieve_wind(*pair, DT, "cc", 6, 14, 4, "cpu", min_correlation=0.6, median_size=5)
    xr.testing.assert_identical(found, expected)
    assert all("\n" not in str(one.message) and one.filename == __file__ for one in said)


def test_series(pair, expected):
    with pytest.warns(DeprecationWarning, match="retrieve_winds: template"):
        winds = retrieve_winds(pair, DT, method="cc", template=6, search=14, stride=4)
    np.testing.assert_array_equal(winds["v"][0], expected["v"])


def test_a_volume_keeps_its_own_stride():
    stack = volumes.shifted((16, 20, 20), (0.3, 0.5, -0.4), 0.01, seed=1)
    with pytest.warns(DeprecationWarning, match=r"WindowSizes\(template=6\)"):
        found = retrieve_wind_volume(*stack, volumes.DT, "correlation", template=6)
    assert found.attrs["stride"] == 4


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: WindowSizes("a"), "template: 'a' is not allowed; expected a whole number"),
        (lambda: WindowSizes(stride=1.5), "stride: 1.5"),
        (lambda: VectorValidation(min_texture=None), "min_texture: None"),
    ],
)
def test_fields_of_other_types_are_named(wrong, message):
    with pytest.raises(InputError) as error:
        wrong()
    assert message in str(error.value)


def test_options_of_another_type_are_named(pair):
    with pytest.raises(InputError, match="windows: 8 is not allowed; expected WindowSizes"):
        retrieve_wind(*pair, DT, windows=8)
