"""The wind of successive slabs: same data set, and when it starts from nothing."""

import numpy as np
import pytest
import xarray as xr

from benchmarks.cases import DT, drifting_pair_images
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.slabs import wind_of_slab
from tests.support.vortex_pairs import uneven

SIZES = {"columns": 100, "rows": 80}


@pytest.fixture(scope="module")
def slabs():
    return [drifting_pair_images(uneven(), noise=0.03, seed=seed, **SIZES) for seed in (1, 2)]


@pytest.mark.slow
def test_the_first_slab_is_that_of_retrieve_wind_and_the_second_starts_from_it(slabs):
    first, second = ((slab.first, slab.second) for slab in slabs)
    wind, flow = wind_of_slab(*first, DT, noise=0.03)
    known = retrieve_wind(*first, DT, "variational", noise=0.03)
    assert wind.attrs.pop("from_start") == 0
    xr.testing.assert_allclose(wind, known)
    assert wind.attrs == known.attrs
    near, flow = wind_of_slab(*second, DT, flow, noise=0.03)
    far = retrieve_wind(*second, DT, "variational", noise=0.03)
    assert near.attrs["from_start"] == 1 and flow is not None
    assert set(near.variables) == set(far.variables)
    np.testing.assert_allclose(near["v"], far["v"], atol=6 * float(far["v_stderr"].mean()))


@pytest.mark.slow
def test_other_air_is_retrieved_from_nothing(slabs):
    _, flow = wind_of_slab(slabs[0].first, slabs[0].second, DT, noise=0.03)
    wind, _ = wind_of_slab(slabs[0].first, slabs[1].second, DT, flow, noise=0.03)
    assert wind.attrs["from_start"] == 0
    assert float((wind["flag"] != 0).mean()) > 0.9


def test_a_change_of_illumination_keeps_no_flow(slabs):
    """It is removed before the retrieval, which the next one would not do."""
    slope = 1 + 0.5 * (slabs[0].second["y"] / 25)
    wind, flow = wind_of_slab(slabs[0].first, slabs[0].second * slope, DT, noise=0.03)
    assert "illumination" in wind.attrs and flow is None
