"""Where coarse-to-fine retrieval starts. Detects a start that strong shear leads astray: all later
passes then correlate the wrong places."""

import numpy as np
import pytest

from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.turning import displacement, turning_pair


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "method", "template", "allowed"),
    [
        ("particles", "variational", 16, 0.1),
        ("particles", "multipass", 16, 0.3),
        pytest.param("particles", "variational", 32, 0.1, marks=pytest.mark.slow),
        pytest.param("texture", "variational", 32, 0.1, marks=pytest.mark.slow),
        # windows of 32 px smooth the core: 0.6 to 1.1 px where air moves by 4 to 8
        pytest.param("particles", "multipass", 32, 1.5, marks=pytest.mark.slow),
        pytest.param("texture", "multipass", 32, 1.0, marks=pytest.mark.slow),
    ],
)
def test_strong_shear_is_followed(kind, method, template, allowed):
    """A rotation of 0.3 px per px, and a quarter of the search region at most: 8 px of 32.

    Median error within 40 px of the middle. With windows of twice the template alone it was 6 to
    8 px for particles.
    """
    pair = turning_pair(kind, 1)
    found = retrieve_wind(
        *pair, 1.0, method, windows=WindowSizes(template=template, search=2 * template, stride=4)
    )
    y, z = np.meshgrid(found["y"], found["z"])
    true = displacement(y, z)
    error = np.hypot(found["v"] - true[0], found["w"] - true[1]).values
    middle = error[np.hypot(y, z) < 40]
    assert np.isfinite(middle).mean() > 0.95
    assert np.nanmedian(middle) < allowed
