"""Images that hold few windows: detects standard errors from too few errors that are too small."""

import numpy as np
import pytest

from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.crosswind import DT, crosswind_pair
from tests.support.flows import axes, data_array


def normalised_errors(method, side, pairs):
    """Mean squares over the valid vectors of each pair of images of `side` px, where there are."""
    found = []
    for seed in range(pairs):
        random = np.random.default_rng([seed, 6])
        mean, length = random.uniform(-8, 8, 2), random.uniform(2, 4)
        images, _ = crosswind_pair(
            500 + seed, length, size=(side, side), mean=mean, circulation=1e-6
        )
        grid = axes(side, side)
        wind = retrieve_wind(
            *(data_array(i, *grid) for i in images),
            DT,
            method,
            windows=WindowSizes(stride=2 if side < 30 else 4),
        )
        good = (wind.flag == 0).values
        off = [
            ((wind[n] - true) / wind[f"{n}_stderr"]).values[good]
            for n, true in zip("vw", mean, strict=True)
        ]
        if good.any():
            found.append(np.mean(np.square(off)))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["cc", "multipass"])
def test_one_window_states_no_error(method):
    assert not normalised_errors(method, 17, 5).size


@pytest.mark.parametrize("side", [28, *(pytest.param(n, marks=pytest.mark.slow) for n in (24, 40))])
@pytest.mark.parametrize(
    "method",
    ["multipass", *(pytest.param(m, marks=pytest.mark.slow) for m in ("cc", "variational"))],
)
def test_errors_from_few_windows(method, side):
    """Variance of normalised errors 0.6 to 1.25, within the scatter of the pairs (two sigma)."""
    found = normalised_errors(method, side, 8)
    if found.size:
        scatter = found.std() / np.sqrt(found.size)
        assert 0.6 - 2 * scatter < found.mean() < 1.25 + 2 * scatter
