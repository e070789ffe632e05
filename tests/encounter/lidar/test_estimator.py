"""The estimator of a slab: the methods of the retrieval, from nothing and from an expected pair."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cases import vortex_pair_images
from lidar_mi.encounter.lidar.estimate import SKIPPED
from lidar_mi.encounter.lidar.estimator import Estimator
from lidar_mi.encounter.lidar.slab_winds import FirstImage
from lidar_mi.schema.reading import load_experiment
from tests.support.vortex_pairs import vector

DT = 0.1


@pytest.fixture(scope="module")
def images():
    return vortex_pair_images(0.03, seed=4)


def test_vortices_from_nothing_and_from_the_last_fit(images):
    estimator = Estimator(load_experiment("wake_sensor"), vectors=False)
    wind, cold, seconds, *_ = estimator.pair_of(FirstImage(images.first, DT, 0.03), images.second)
    assert wind is None and cold.success and not cold.from_start
    warm = estimator.pair_of(FirstImage(images.first, DT, 0.03, expected=cold), images.second).pair
    assert warm.success and warm.from_start
    stderr = np.sqrt(np.diag(cold.covariance))
    assert (np.abs(warm.parameters - cold.parameters) < 0.1 * stderr).all()
    assert (np.abs(warm.parameters - vector(*images.vortices)) < 4 * stderr).all()
    assert set(seconds) == {"vortices"} and seconds["vortices"] > 0
    warm = estimator.pair_of(FirstImage(images.first, DT, 0.03, expected=cold), images.second)
    assert set(warm.seconds) == {"vortices_before", "vortices"}


def test_slopes_that_are_expected_correct_the_fit(images):
    estimator = Estimator(load_experiment("wake_sensor"), vectors=False)
    cold = estimator.pair_of(FirstImage(images.first, DT, 0.03), images.second).pair
    slopes = np.array([0.4, 0.0])
    told = replace(cold, slopes=slopes, slope_covariance=np.zeros((2, 2)))

    def given(pair):
        return FirstImage(images.first, DT, 0.03, expected=pair), images.second

    plain = estimator.pair_of(*given(told)).pair
    telescope = (-148.75, 0.0, 0.0)
    seen = estimator.pair_of(*given(cold), telescope=telescope).pair
    assert plain.slopes is None and seen.slopes is None
    np.testing.assert_array_equal(plain.parameters, seen.parameters)
    found = estimator.pair_of(*given(told), telescope=telescope).pair
    expected = seen.with_slopes(slopes, np.zeros((2, 2)))
    np.testing.assert_allclose(found.parameters, expected.parameters)
    np.testing.assert_allclose(found.covariance, expected.covariance)


@pytest.mark.slow
def test_the_wind_is_by_the_most_accurate_method(images):
    estimator = Estimator(load_experiment("wake_sensor"))
    wind, _, seconds, *_ = estimator.pair_of(FirstImage(images.first, DT, 0.03), images.second)
    assert wind.attrs["method"] == "variational"
    valid = wind["flag"] == 0
    assert valid.mean() > 0.9
    off = wind["v"] - images.v.interp(y=wind["y"], z=wind["z"])
    assert float(off.where(valid).std()) < 0.5
    assert set(seconds) == {"vortices", "wind_before", "wind"}
    first = FirstImage(images.first, DT, 0.03)
    found = estimator.pair_of(first, images.second, take=(False, False))
    assert found.wind is None and not found.seconds
    assert found.pair.reasons == (SKIPPED,) and found.flags == (f"wind: {SKIPPED}",)
