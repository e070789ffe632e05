"""The probability that images show a vortex, and fits from the likeliest pair.

Simulation-based calibration on draws of a stated prior (`validation.detections`) that took no part
in the calibration. Detects probabilities that are too sure or not sure enough, fits that a search
would have found, pairs in air without any.
"""

import numpy as np
import pytest
import torch

from benchmarks.cases import DT, drifting_pair_images
from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.detection import probability_of
from lidar_mi.retrieval.vortices.image_fit import detected_fit, fit_vortices
from tests.support.vortex_pairs import uneven, vector
from validation.detections import CALIBRATION, KINDS, calibrated, draw, inside, log_ratios

SMALL = {"columns": 130, "rows": 90}


@pytest.fixture(scope="module")
def images():
    return drifting_pair_images(uneven(), (1.0, -0.5), 0.03, seed=3, **SMALL)


def test_the_same_fit_as_by_a_search(images):
    found = detected_fit(images.first, images.second, DT, 0.03)
    searched = fit_vortices(images.first, images.second, DT, 0.03)
    assert found.success and searched.success and not found.from_start
    assert found.probability > 0.99 and np.isnan(searched.probability)
    stderr = np.sqrt(np.diag(searched.covariance))
    assert (np.abs(found.parameters - searched.parameters) < 0.2 * stderr).all()
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), stderr, rtol=0.05)
    truth = vector(*images.vortices, mean=(1.0, -0.5))
    assert (np.abs(found.parameters - truth) < 4 * stderr).all()


def test_unknown_noise_and_pixels(images):
    second = images.second.copy()
    second[30:36, 50:58] = np.nan
    found = detected_fit(images.first, second, DT)
    assert found.success and found.probability > 0.99
    np.testing.assert_allclose(found.parameters[[2, 3, 6, 7]], [13, 1, -12, -2], atol=0.3)


def test_images_without_a_wake():
    air = draw(3, "uniform")
    found = detected_fit(air.first, air.second, 0.1, air.noise)
    assert not found.success and 0 < found.probability < 0.2
    constant = detected_fit(0 * air.first + 1, air.second, 0.1)
    assert constant.reasons == ("an image is constant",) and np.isnan(constant.probability)
    with pytest.raises(InputError, match=r"^dt: "):
        detected_fit(air.first, air.second, 0.0)


def test_probability_grows_with_the_likelihood():
    found = [probability_of(ratio) for ratio in (-np.inf, -20, -3, 0, 5, 30, 500, np.inf)]
    assert (np.diff(found) >= 0).all() and 0 < found[0] < 0.02 and 0.99 < found[-1] < 1
    assert found[0] == found[1] and found[-2] == found[-1]


def reliable(probability, there):
    """Whether outcomes are as probable as stated, within chance and that of the calibration.

    Their number, and the test of Spiegelhalter (1986, Stat. Med. 5, 421-433), which is sensitive to
    probabilities that are too sure or not sure enough.
    """
    variance = probability * (1 - probability)
    surprise = there - probability
    sure = 1 - 2 * probability
    more = np.sqrt(1 + len(there) / len(CALIBRATION))
    number = surprise.sum() / np.sqrt(variance.sum())
    spread = (surprise * sure).sum() / np.sqrt((sure**2 * variance).sum())
    return abs(number) < 3 * more and abs(spread) < 3 * more


@pytest.mark.slow
def test_probabilities_hold_on_other_draws():
    """120 draws; the test sees probabilities that are all 0.15 higher, and odds squared."""
    ratio, there = log_ratios(range(120))
    probability = np.array([probability_of(one) for one in ratio])
    assert reliable(probability, there)
    assert not reliable(np.clip(probability + 0.15, 0, 1 - 1e-3), there)
    odds = (probability / (1 - probability)) ** 2
    assert not reliable(odds / (1 + odds), there)


def test_log_odds_are_those_of_greatest_likelihood():
    """Of outcomes drawn with known odds: those of the nodes, within 4 of their errors of 0.2."""
    random = np.random.default_rng(7)
    ratio = np.sinh(random.uniform(-2.5, 6, 8000))
    odds = np.interp(np.arcsinh(ratio), [-2.5, 6], [-3, 3])
    there = random.random(8000) < 1 / (1 + np.exp(-odds))
    fitted = calibrated(ratio, there)
    nodes = np.interp([-2.5, -1, 0, 1, 2.5, 4, 6], [-2.5, 6], [-3, 3])
    np.testing.assert_allclose(fitted, nodes, atol=0.8)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_pair_is_accepted_in_air_without_one(kind):
    """60 draws each; of the probabilities above 0.9 there are few."""
    sure = 0
    for seed in range(60):
        air = draw(seed, kind)
        found = detected_fit(air.first, air.second, 0.1, air.noise)
        assert not found.success
        sure += found.probability > 0.9
    # a tenth of those above 0.9 at most, where half of the air has a wake: 3 sigma of 6
    assert sure <= 6 + 3 * np.sqrt(6)


@pytest.mark.slow
def test_as_many_fits_as_by_a_search():
    """40 draws of wakes: 95 % of the search's fits; all accepted ones are those of the truth."""
    both = searched = 0
    with torch.inference_mode():
        for seed in range(40):
            wake = draw(seed, "pair")
            found = detected_fit(wake.first, wake.second, 0.1, wake.noise)
            if found.success:
                truth = vector(*wake.vortices, mean=wake.mean_wind)
                off = (found.parameters - truth)[[0, 2, 3, 4, 6, 7]]
                stderr = np.sqrt(np.diag(found.covariance))[[0, 2, 3, 4, 6, 7]]
                # turbulence about the pair is no part of the truth
                assert (np.abs(off) < 5 * stderr + [30, 1, 1, 30, 1, 1]).all()
            if inside(wake.vortices, wake.first) == 2:
                by_search = fit_vortices(wake.first, wake.second, 0.1, wake.noise)
                searched += by_search.success
                both += by_search.success and found.success
    assert searched >= 10 and both >= 0.95 * searched
