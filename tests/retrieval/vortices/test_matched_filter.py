"""Matched filters for pairs of vortices, on images that are linear in the wind, and by brute force.

Unit tests. Detect likelihoods that are not those of the Bayesian regression, places off by more
than the raster, winds and brightness that count as vortices.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.stats import multivariate_normal

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.retrieval.vortices.matched_filter import _explained, matched_filter
from lidar_mi.retrieval.vortices.model import PROFILES

ROWS, COLUMNS, DT, NOISE = 61, 91, 0.1, 0.02
PAIR = Vortex(320.0, 3.5, 62.0, 33.0), Vortex(-300.0, 3.0, 33.0, 27.0)


def images(vortices=(), wind=lambda y, z: (0 * y, 0 * y), noise=NOISE, seed=1):
    """I1 and I2 = I1 - dt u . grad I1, places in m from the first pixel, 1 m apart."""
    random = np.random.default_rng(seed)
    air = gaussian_filter(random.normal(size=(ROWS, COLUMNS)), 2.5)
    air /= air.std()
    y, z = np.meshgrid(np.arange(COLUMNS, dtype=float), np.arange(ROWS, dtype=float))
    slope_z, slope_y = np.gradient(air)
    v, w = wind(y, z)
    if vortices:
        swirl = velocity(vortices, y, z)
        v, w = v + swirl[0], w + swirl[1]
    moved = air - DT * (v * slope_y + w * slope_z)
    pair = np.stack([air, moved]) + noise * random.standard_normal((2, ROWS, COLUMNS))
    return torch.as_tensor(pair)


def found(pair, noise=NOISE, profile="lamb_oseen"):
    return matched_filter(pair, (1.0, 1.0), DT, noise, profile)


def test_reduction_and_determinant_are_those_of_bayesian_regression():
    """Of two columns, against the marginal likelihood of all observations (scipy)."""
    random = np.random.default_rng(3)
    columns, value = random.normal(size=(40, 5)), random.normal(size=40)
    covariance = 2.5 * np.array([[1, -0.8], [-0.8, 1]])
    prior = np.linalg.inv(covariance)
    normal, force = torch.as_tensor(columns.T @ columns), torch.as_tensor(columns.T @ value)
    gain, first, second, determinant = _explained(normal, force, (prior[0, 0], prior[0, 1]))
    for p, q in ((0, 1), (2, 4), (3, 0)):
        two = columns[:, [p, q]]
        with_pair = multivariate_normal(np.zeros(40), np.eye(40) + two @ covariance @ two.T)
        ratio = with_pair.logpdf(value) - multivariate_normal(np.zeros(40)).logpdf(value)
        mine = (gain[p, q] - torch.log(determinant[p, q] * np.linalg.det(covariance))) / 2
        assert float(mine) == pytest.approx(ratio, rel=1e-9)
        mean = np.linalg.solve(two.T @ two + prior, two.T @ value)
        np.testing.assert_allclose([first[p, q], second[p, q]], mean, rtol=1e-9)


@pytest.mark.parametrize("profile", PROFILES)
def test_the_likeliest_pair_is_near_the_true_one(profile):
    """To the raster of 3.6 m, and the circulations to a quarter."""
    likely = found(images(PAIR), profile=profile)
    assert likely.log_ratio > 50
    pair = likely.pair.numpy()
    np.testing.assert_allclose(pair[[2, 3, 6, 7]], [62, 33, 33, 27], atol=3.6)
    np.testing.assert_allclose(pair[[0, 4]], [320, -300], rtol=0.25)
    assert (pair[8:] == 0).all()


def test_a_vortex_whose_partner_is_beyond_the_image_is_found():
    pair = Vortex(320.0, 3.5, 80.0, 30.0), Vortex(-320.0, 3.0, 50.0, 30.0)
    shifted = tuple(Vortex(o.circulation, o.core_radius, o.y + 22, o.z) for o in pair)
    likely = found(images(shifted))
    assert likely.log_ratio > 20
    np.testing.assert_allclose(likely.pair[6:8], [72, 30], atol=4)
    assert likely.pair[2] > COLUMNS - 1


def test_smooth_winds_and_brightness_are_no_vortices():
    """A mean wind, shear, curvature of the wind, and a gain change the ratio by half at most.

    They are errors of the linear images where slopes are steep; without a wake it stays below 1.
    """
    noise = 0.25
    still = found(images(PAIR, noise=noise), noise).log_ratio
    assert still > 20
    for wind in (
        lambda y, z: (6.0 + 0 * y, -4.0 + 0 * y),
        lambda y, z: (0.2 * (z - 30), 0.1 * (y - 45)),
        lambda y, z: (0.003 * (z - 30) ** 2, 0 * y),
    ):
        windy = found(images(PAIR, wind, noise), noise)
        assert windy.log_ratio == pytest.approx(still, rel=0.5)
        assert found(images((), wind, noise), noise).log_ratio < 0
    brighter = images(PAIR, noise=noise)
    brighter[1] = 1.1 * brighter[1] + 0.3
    assert found(brighter, noise).log_ratio == pytest.approx(still, rel=0.5)


def test_the_opposite_sense_is_no_wake():
    """Starboard up, port down: the likeliest wake explains little of it."""
    mirrored = tuple(Vortex(-o.circulation, o.core_radius, o.y, o.z) for o in PAIR)
    ours, other = found(images(PAIR)), found(images(mirrored))
    # pairs may be upside down: it is found with its vortices exchanged
    assert other.log_ratio > 50
    np.testing.assert_allclose(other.pair[[2, 3, 6, 7]], [33, 27, 62, 33], atol=3.6)
    np.testing.assert_allclose(ours.pair[[2, 3]], [62, 33], atol=3.6)


def test_images_that_say_nothing():
    """Noise alone, and air at rest: the likelihood of a wake is lower."""
    random = np.random.default_rng(5)
    noise = torch.as_tensor(random.standard_normal((2, ROWS, COLUMNS)))
    assert found(noise, 1.0).log_ratio < 1
    assert found(images()).log_ratio < 0
    same = found(images(noise=0.0), 0.0)
    assert same.log_ratio == -np.inf and same.pair is None
