"""Errors that resampling of scattered beams leaves, against fields known everywhere.

Detects a variance that is wrong by a factor of 2.5, and weights of other times.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.images.resampling_error import (
    Variogram,
    correlation_area,
    flag_resampled,
    variance,
)
from tests.support.flows import axes, data_array, plane_waves, texture

MEAN, NOISE = (3.0, -4.0), 0.03


def test_variance_of_two_beams_by_hand():
    """A node half way between two beams, of which one is later."""
    found = Variogram(2.0, 1.5, 1.0, 3.0, 0.1)

    def gamma(square):
        return 2.0 * (1 - 1 / (1 + square / (2 * 1.5**2)))

    places = np.array([[[-0.5, 0.0], [0.5, 0.0]]])
    weights, times = np.full((1, 2), 0.5), np.array([[-0.1, 0.1]])
    expected = 2 * gamma(0.25 + 0.09) - 0.5 * gamma(1 + 0.36)
    np.testing.assert_allclose(variance(found, weights, places, times), expected, rtol=1e-12)


def test_a_beam_on_its_node_leaves_nothing():
    found = Variogram(1.0, 2.0, 0.5, 0.0, 0.0)
    places, weights = np.array([[[0.0, 0.0], [1.0, 0.0]]]), np.array([[1.0, 0.0]])
    assert variance(found, weights, places, np.zeros((1, 2))) == pytest.approx(0, abs=1e-15)


def test_pixels_for_an_error():
    """Of a grid of beams 2 px apart: 1.5 beams, 6 px, to the 12 beams' own grain of a third."""
    grid = 2.0 * np.stack(np.meshgrid(np.arange(30), np.arange(30)), -1).reshape(-1, 2)
    nodes = np.random.default_rng(1).uniform(20, 40, (200, 2))
    assert correlation_area(grid, nodes).mean() == pytest.approx(6, rel=0.33)


@pytest.mark.slow
@pytest.mark.parametrize(("length", "px"), [(3.0, 0.3), (3.0, 0.6), (2.5, 0.6)])
def test_error_stated_is_the_one_made(length, px):
    """In sums over 7 x 7 nodes, of texture with 5 % of noise: not too small by more than 4 sigma.

    The scatter of 96 sums is 14 % of their variance. Their standard deviation may be 1.6 times too
    large, as the smallest scales of texture are hard to tell.
    """
    y, z = axes(84, 56)
    waves, nodes = plane_waves(2, length, 0.5), np.stack(np.meshgrid(y, z))
    random = np.random.default_rng(3)
    places = nodes + 0.5 * px * random.standard_normal(nodes.shape)
    exact, seen = texture(waves, *nodes), texture(waves, *places)
    noise = np.full(seen.shape, 0.01)
    fields = {"y_reported": places[0], "z_reported": places[1], "Y_noise_std": noise}
    fields["Y"] = seen + noise * random.standard_normal(seen.shape)
    found = on_nodes(xr.Dataset({k: data_array(f, y, z) for k, f in fields.items()}))
    off = (found["Y"] - exact).coarsen(y=7, z=7).sum()
    stated = found["Y_noise_std"] ** 2 + found["Y_resampling_std"] ** 2
    ratio = float((stated.coarsen(y=7, z=7).sum() / off.var()).mean()) ** 0.5
    assert (1 - 4 * 0.14) ** 0.5 < ratio < 1.6


def test_vectors_are_flagged_where_more_is_lost_than_noise():
    """Over templates of 4 px in one half of an image, and half a template beside it."""
    y, z = axes(24, 16)
    noise = data_array(np.full((16, 24), 0.01), y, z)
    with_it = noise * np.where(np.arange(24) < 12, 1.1, 3.0)
    count = np.zeros((8, 12), np.uint16)
    fields = {"flag": (("z", "y"), count), "v": (("z", "y"), 0.0 * count)}
    wind = xr.Dataset(fields, {"z": z[1::2], "y": y[1::2]}, {"template": 4})
    found = flag_resampled(wind, noise, with_it)["flag"]
    assert found.dtype == np.uint16
    assert (found[:, :5] == 0).all() and (found[:, 5:] == Flag.RESAMPLED).all()
    # 7 of 12 columns; of those with a displacement 7 of 10, which is beyond two thirds
    few = wind.assign(v=wind["v"].where(np.arange(12) >= 2))
    assert (flag_resampled(few, noise, with_it)["flag"] == Flag.RESAMPLED).all()


def test_error_of_beams_that_are_dense_in_calm_air_only():
    """Sparse beams in rough air, many in smooth air: the error is the rough air's, to a factor 2.

    A variogram of all beams, of which most are in smooth air, states a tenth of it.
    """
    y, z = axes(60, 60)
    random, waves = np.random.default_rng(4), plane_waves(3, 2.5, 0.5)
    grid = np.stack(np.meshgrid(y, z))
    places = grid + 0.25 * random.standard_normal(grid.shape)
    rough = grid[0] < np.median(y)
    # every second beam of rough air looks at smooth air
    away = rough & (random.random(rough.shape) < 0.5)
    places[:, away] += np.array([[np.ptp(y) / 2], [0.0]]) + 0.05 * random.standard_normal(
        (2, away.sum())
    )

    def air(y, z):
        return 1 + np.where(y < np.median(grid[0]), 1.0, 0.01) * (texture(waves, y, z) - 1)

    fields = {"y_reported": places[0], "z_reported": places[1], "Y": air(*places)}
    found = on_nodes(xr.Dataset({k: data_array(f, y, z) for k, f in fields.items()}))
    off = (found["Y"] - air(*grid)).values
    inside = np.isfinite(off) & (grid[0] < np.median(y) - 4)
    stated = (found["Y_resampling_std"].values[inside] ** 2).mean() ** 0.5
    # per pixel; what is stated counts as white noise, twice to 4 times the variance
    made = (off[inside] ** 2).mean() ** 0.5
    assert made < stated < 4 * made
