"""The estimator of a slab: the methods of the retrieval, from nothing and from an expected pair."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cases import drifting_pair_images, vortex_pair_images
from benchmarks.realtime import UNFORESEEN
from lidar_mi.encounter.estimator import Estimator, _with_delay
from lidar_mi.experiment.schema.reading import load_experiment
from tests.support.vortex_pairs import uneven, vector

DT = 0.1


@pytest.fixture(scope="module")
def images():
    return vortex_pair_images(0.03, seed=4)


def test_vortices_from_nothing_and_from_the_last_fit(images):
    estimator = Estimator(load_experiment("wake_sensor"), vectors=False)
    wind, cold, seconds, *_ = estimator.pair_of(images.first, images.second, DT, 0.03)
    assert wind is None and cold.success and not cold.from_start
    warm = estimator.pair_of(images.first, images.second, DT, 0.03, cold).pair
    assert warm.success and warm.from_start
    stderr = np.sqrt(np.diag(cold.covariance))
    assert (np.abs(warm.parameters - cold.parameters) < 0.1 * stderr).all()
    assert (np.abs(warm.parameters - vector(*images.vortices)) < 4 * stderr).all()
    assert set(seconds) == {"vortices", "total"} and seconds["vortices"] > 0
    warm = estimator.pair_of(images.first, images.second, DT, 0.03, cold)
    assert set(warm.seconds) == {"vortices_before", "vortices", "total"}


def test_what_is_not_finished_at_the_second_image_is_in_the_total():
    """Each process finishes the last slab, then works ahead; lines come half a period before."""
    parts = {"lines": 0.03, "vortices_before": 0.01, "wind_before": 0.04}
    parts |= {"vortices": 0.06, "wind": 0.03, "combination": 0.02, "total": 0.065}

    def total(change, since, processes=2):
        seconds = parts | change
        return seconds, _with_delay(seconds, since, DT, processes)

    seconds, busy = total({}, (0.06, 0.05))
    # both have time: at 0.1 s the lines, of 0.07 to 0.1 s, have just been read
    assert seconds["total"] == pytest.approx(0.065) and busy == pytest.approx([0.06, 0.05])
    seconds, busy = total({"lines": 0.055}, (0.0, 0.0))
    assert seconds["total"] == pytest.approx(0.07) and busy == pytest.approx([0.065, 0.05])
    # 0.08 s of the last slab's wind and 0.04 s before: 0.02 s late, the wind takes 0.01 s longer
    seconds, busy = total({}, (0.06, 0.08))
    assert seconds["total"] == pytest.approx(0.075) and busy == pytest.approx([0.06, 0.07])
    seconds, busy = total({}, (0.1, 0.1), processes=1)
    # 0.1 s of the last slab, 0.05 s before and the lines: 0.08 s late, but no more is carried over
    assert seconds["total"] == pytest.approx(0.065 + 0.08) and busy == pytest.approx([DT, DT])


def test_slopes_that_are_expected_correct_the_fit(images):
    estimator = Estimator(load_experiment("wake_sensor"), vectors=False)
    cold = estimator.pair_of(images.first, images.second, DT, 0.03).pair
    slopes = np.array([0.4, 0.0])
    told = replace(cold, slopes=slopes, slope_covariance=np.zeros((2, 2)))
    given = images.first, images.second, DT, 0.03
    plain = estimator.pair_of(*given, told).pair
    telescope = (-148.75, 0.0, 0.0)
    seen = estimator.pair_of(*given, cold, telescope=telescope).pair
    assert plain.slopes is None and seen.slopes is None
    np.testing.assert_array_equal(plain.parameters, seen.parameters)
    found = estimator.pair_of(*given, told, telescope=telescope).pair
    expected = seen.with_slopes(slopes, np.zeros((2, 2)))
    np.testing.assert_allclose(found.parameters, expected.parameters)
    np.testing.assert_allclose(found.covariance, expected.covariance)


def test_the_wind_is_by_the_most_accurate_method(images):
    estimator = Estimator(load_experiment("wake_sensor"))
    wind, _, seconds, *_ = estimator.pair_of(images.first, images.second, DT, 0.03)
    assert wind.attrs["method"] == "variational"
    valid = wind["flag"] == 0
    assert valid.mean() > 0.9
    off = wind["v"] - images.v.interp(y=wind["y"], z=wind["z"])
    assert float(off.where(valid).std()) < 0.5
    assert set(seconds) == {"vortices", "wind_before", "wind", "total"}


def test_the_next_slab_starts_from_the_last_one():
    """Half a pixel on, with other texture: as accurate as from nothing."""
    near, far = (Estimator(load_experiment("wake_sensor")) for _ in range(2))
    last, errors = None, {"near": [], "far": []}
    for seed, y in ((1, 0.0), (2, 0.25)):
        vortices = [replace(v, y=v.y + y) for v in uneven()]
        slab = drifting_pair_images(vortices, (0.5, 0.0), 0.03, seed, columns=130, rows=90)
        found = near.pair_of(slab.first, slab.second, DT, 0.03, last)
        last = replace(found.pair, covariance=found.pair.covariance + np.diag(UNFORESEEN**2))
        for name, one in {
            "near": found,
            "far": far.pair_of(slab.first, slab.second, DT, 0.03),
        }.items():
            off = one.wind["v"] - slab.v.interp(y=one.wind["y"], z=one.wind["z"])
            errors[name].append(float(off.std()))
    assert found.wind.attrs["from_start"] == 1 and found.pair.from_start
    assert errors["near"][1] < 1.05 * errors["far"][1]
