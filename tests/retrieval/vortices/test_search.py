"""Where fits of a vortex pair start: least squares pair by pair.

Unit tests. Detect a pair of the wrong sense, places off by more than the grid, worse pairs ahead
of better ones.
"""

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.retrieval.vortices.model import PROFILES
from lidar_mi.retrieval.vortices.search import Observations, condensed, starting_points

PAIR = Vortex(320.0, 3.5, 14.0, 3.0), Vortex(-280.0, 3.0, -15.0, -4.0)
COLUMNS, ROWS = 61, 41


def observed(vortices, mean=(0.0, 0.0), noise=0.0, seed=1, angle=None):
    """Both components on a grid of 1 m, or the one along a direction (rad)."""
    y, z = ((np.arange(n) - (n - 1) / 2) for n in (COLUMNS, ROWS))
    y, z = (part.ravel() for part in np.meshgrid(y, z))
    v, w = velocity(vortices, y, z) + np.array(mean)[:, None]
    random = np.random.default_rng(seed)
    if angle is None:
        y, z = np.tile(y, 2), np.tile(z, 2)
        along = np.repeat(np.eye(2), len(v), axis=1)
        value = np.concatenate([v, w])
    else:
        along = np.array([np.cos(angle), np.sin(angle)])[:, None] + np.zeros_like(v)
        value = along[0] * v + along[1] * w
    value = value + noise * random.standard_normal(value.shape)
    return Observations(
        *(torch.as_tensor(part) for part in (y, z, along, value, np.ones_like(value)))
    )


def misfit(start, data):
    """Sum of squares that best circulations and mean wind leave at the start's places and radii."""
    columns = []
    for first in (0, 4):
        vortex = Vortex(1.0, float(start[first + 1].exp()), *start[first + 2 : first + 4].tolist())
        swirl = velocity([vortex], data.y.numpy(), data.z.numpy())
        columns.append((data.along.numpy() * swirl).sum(0))
    columns = np.stack([*columns, *data.along.numpy()], 1)
    return float(np.linalg.lstsq(columns, data.value.numpy(), rcond=None)[1][0])


@pytest.mark.slow
@pytest.mark.parametrize("angle", [None, 0.9], ids=["v and w", "one component"])
@pytest.mark.parametrize("mean", [(0.0, 0.0), (8.0, -3.0)])
def test_the_pair_is_detected_whatever_wind_advects_it(angle, mean):
    """To the step of the places that are tried, 60 m x 40 m by 700: 1.9 m."""
    start = starting_points(observed(PAIR, mean, 0.3, angle=angle), 1, "lamb_oseen")[0].numpy()
    places = start[[2, 3, 6, 7]]
    np.testing.assert_allclose(places, [14.0, 3.0, -15.0, -4.0], atol=1.9)
    np.testing.assert_allclose(start[[0, 4]], [320, -280], rtol=0.15)
    off = start[8:] - mean
    if angle is not None:  # a mean wind across it is not observed
        off = off @ [np.cos(angle), np.sin(angle)]
    np.testing.assert_allclose(off, 0, atol=0.6)


@pytest.mark.parametrize("profile", PROFILES)
def test_starts_are_pairs_in_order_of_misfit(profile):
    """Oppositely rotating, three core radii apart, each better than the next by least squares of
    its own (which knows the Lamb-Oseen profile alone)."""
    data = observed(PAIR, noise=0.3)
    starts = starting_points(data, 5, profile)
    assert starts.shape == (5, 10)
    apart = torch.hypot(starts[:, 2] - starts[:, 6], starts[:, 3] - starts[:, 7])
    assert (starts[:, 0] > 0).all() and (starts[:, 4] < 0).all()
    assert (apart > 3 * starts[:, 1].exp()).all()
    if profile == "lamb_oseen":
        left = [misfit(start, data) for start in starts]
        assert left == sorted(left)


def test_circulations_are_those_of_least_squares():
    """At the places of the best start, from the normal equations of numpy."""
    data = observed(PAIR, (2.0, 1.0), 0.3)
    start = starting_points(data, 1, "lamb_oseen")[0]
    columns = []
    for first in (0, 4):
        vortex = Vortex(1.0, float(start[first + 1].exp()), *start[first + 2 : first + 4].tolist())
        swirl = velocity([vortex], data.y.numpy(), data.z.numpy())
        columns.append((data.along.numpy() * swirl).sum(0))
    columns = np.stack([*columns, *data.along.numpy()], 1)
    best = np.linalg.lstsq(columns, data.value.numpy(), rcond=None)[0]
    np.testing.assert_allclose(start[[0, 4, 8, 9]], best, rtol=1e-9)


def test_vortices_of_one_sense_are_no_pair():
    """Two that rotate alike leave only pairs that explain less than the two would."""
    alike = Vortex(300.0, 3.0, 15.0, 0.0), Vortex(300.0, 3.0, -15.0, 0.0)
    for start in starting_points(observed(alike), 3, "lamb_oseen"):
        assert start[0] > 0 > start[4]


def test_still_air_has_no_pair():
    assert starting_points(observed(()), 3, "lamb_oseen").shape == (0, 10)


def test_brightness_is_no_wind():
    """A change of the values across the region, four times the swirl's, is fitted beside it."""
    data = observed(PAIR, noise=0.3)
    columns = torch.stack([torch.ones_like(data.y), data.y / data.y.max()])
    changed = data._replace(value=data.value + 20 * columns[1] - 5, brightness=columns)
    start = starting_points(changed, 1, "lamb_oseen")[0].numpy()
    np.testing.assert_allclose(start[[2, 3, 6, 7]], [14.0, 3.0, -15.0, -4.0], atol=1.9)
    np.testing.assert_allclose(start[[0, 4]], [320, -280], rtol=0.15)


@pytest.mark.parametrize("angle", [None, 0.9], ids=["v and w", "one component"])
def test_blocks_tell_as_much_as_all_that_is_in_them(angle):
    """Winds that are uniform over each block have the same weighted least squares."""
    data = observed(PAIR, (3.0, -2.0), 0.5, angle=angle)
    random = np.random.default_rng(3)
    data = data._replace(weight=torch.as_tensor(random.uniform(0.5, 2.0, len(data.y))))
    few = condensed(data)
    assert len(few.y) < 0.7 * len(data.y)

    def mean_wind(part):
        columns = (part.along * part.weight.sqrt()).T.numpy()
        values = (part.value * part.weight.sqrt()).numpy()
        return np.linalg.lstsq(columns, values, rcond=None)[0], columns.T @ columns

    for one, other in zip(mean_wind(data), mean_wind(few), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-3 * np.abs(one).max())
    best, same = (starting_points(part, 1, "lamb_oseen")[0] for part in (data, few))
    np.testing.assert_allclose(same[[2, 3, 6, 7]], best[[2, 3, 6, 7]], atol=2.0)
    np.testing.assert_allclose(same[[0, 4]], best[[0, 4]], rtol=0.1)
