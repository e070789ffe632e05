"""What a vortex model misses: sums over all pairs of places, fields drawn from known covariance.

Physics tests. Detect a wrong factor in a correlation or a matrix, an error of a quarter in the
variance of the missed flow, and noise of pixels taken for it. A departure that a fit follows is
found as it was before: against the covariances of all pairs of places.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lidar_mi.retrieval.vortices.model_error import (
    Lags,
    ModelError,
    Response,
    lags_used,
    mean_length,
    model_error,
    of_change,
    spread_of,
)

ERROR = ModelError((0.3, 0.1), (2.0, 5.0))


def distances(shape):
    """Between all places of a grid, steps."""
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
    return np.linalg.norm(places[:, None] - places, axis=-1)


def dense(error, shape):
    """Covariance matrix of one component over a grid."""
    h = distances(shape)
    return sum(
        a * np.exp(-(h**2) / (2 * n**2))
        for a, n in zip(error.variances, error.lengths, strict=True)
    )


def test_covariance_is_a_sum_of_gaussians():
    at = torch.tensor([0.0, 2.0, 10.0], dtype=torch.float64)
    expected = [
        0.4,
        0.3 * np.exp(-0.5) + 0.1 * np.exp(-0.08),
        0.3 * np.exp(-12.5) + 0.1 * np.exp(-2),
    ]
    np.testing.assert_allclose(ERROR.covariance(at), expected, rtol=1e-12)
    assert ERROR.variance == pytest.approx(0.4)
    assert mean_length(ERROR) == pytest.approx((0.3 * 2 + 0.1 * 5) / 0.4)
    assert mean_length(ModelError()) == 0 and ModelError().variance == 0


@pytest.mark.parametrize("shape", [(7, 9), (8, 5)])
def test_autocorrelation_is_the_sum_over_pairs(shape):
    random = torch.Generator().manual_seed(2)
    fields = torch.randn(2, *shape, generator=random, dtype=torch.float64)
    lags = Lags(shape, fields)
    found = lags.autocorrelation(fields, (1.0, 3.0))
    distance = lags.distance()
    for dz, dy in ((0, 0), (2, 1), (1, -3), (shape[0] - 1, 0)):
        expected = 0.0
        for weight, field in zip((1.0, 3.0), fields.numpy(), strict=True):
            for z in range(shape[0]):
                for y in range(shape[1]):
                    if 0 <= z + dz < shape[0] and 0 <= y + dy < shape[1]:
                        expected += weight * field[z, y] * field[z + dz, y + dy]
        assert float(found[dz, dy]) == pytest.approx(expected, rel=1e-10, abs=1e-10)
        assert float(distance[dz, dy]) == pytest.approx(np.hypot(dz, dy))


def test_lags_within_reach_are_those_of_the_whole_grid():
    fields = torch.randn(1, 40, 61, generator=torch.Generator().manual_seed(3)).double()
    few, every = lags_used(fields), Lags((40, 61), fields)
    assert few.reach == 2 * 6.0 and few.sizes[0] < every.sizes[0]
    found, expected = (lags.autocorrelation(fields, (1.0,)) for lags in (few, every))
    for dz, dy in ((0, 0), (12, 0), (3, 12), (5, -12)):
        assert float(found[dz, dy]) == pytest.approx(float(expected[dz, dy]), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("shape", [(9, 11), (12, 8)])
def test_spread_is_that_of_the_dense_matrix(shape):
    """P C P^T, one component after the other; the Gaussians' spectrum loses 1e-6 to the padding."""
    responses = torch.randn(
        3, 2, *shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    flat = responses.flatten(2).numpy()
    matrix = dense(ERROR, shape)
    expected = sum(flat[:, a] @ matrix @ flat[:, a].T for a in (0, 1))
    size = np.abs(expected).max()
    np.testing.assert_allclose(spread_of(responses, ERROR), expected, atol=2e-2 * size)
    assert (spread_of(responses, ModelError()) == 0).all()


def residuals(variance, length, noise, seed, shape=(40, 50)):
    """Force and stiffness of residuals r = g . d + n, slopes and displacement drawn at random."""
    random = np.random.default_rng(seed)
    axes = [np.arange(n) for n in shape]
    # the covariance is a product over the axes, and so is its root
    roots = [
        np.linalg.cholesky(
            np.exp(-((a[:, None] - a) ** 2) / (2 * length**2)) + 1e-9 * np.eye(len(a))
        )
        for a in axes
    ]
    d = [np.sqrt(variance) * roots[0] @ random.standard_normal(shape) @ roots[1].T for _ in "yz"]
    g = random.standard_normal((2, *shape))
    r = g[0] * d[0] + g[1] * d[1] + noise * random.standard_normal(shape)
    weight = 1 / (noise**2 + variance * (g**2).sum(0))
    force = weight * g * r
    stiffness = weight * np.stack([g[0] ** 2, g[0] * g[1], g[1] ** 2])
    return [torch.as_tensor(part) for part in (force, stiffness)]


def test_variance_and_length_are_those_drawn():
    """16 draws (seeds 0 to 15) of 0.04 m^2 over 6 steps: 2 x 2000 / (4 pi 36) = 9 independent
    values a draw of noise 0.1, whose mean square scatters by sqrt(2 / 140) = 12 % in all."""
    found = [model_error(*residuals(0.04, 6.0, 0.1, seed), 1.0) for seed in range(16)]
    assert np.mean([one.variance for one in found]) == pytest.approx(0.04, rel=0.36)
    lengths = [mean_length(one) for one in found]
    assert np.mean(lengths) == pytest.approx(6.0, rel=0.36)


def test_noise_of_pixels_is_no_flow():
    """White residuals of standard deviation 0.1, slopes of 1: as a flow, this would be 0.01 m^2."""
    found = [model_error(*residuals(0.0, 6.0, 0.1, seed), 1.0).variance for seed in range(8)]
    assert np.mean(found) < 2e-4


def test_without_residuals_there_is_no_model_error():
    nothing = torch.zeros(3, 20, 20, dtype=torch.float64)
    assert model_error(nothing[:2], nothing, 1.0) == ModelError()


def smooth(random, shape, length):
    """A field of unit variance with the correlation exp(-h^2 / (4 length^2))."""
    return gaussian_filter(random.standard_normal(shape), length, mode="wrap") * length * 3.545


def test_change_of_the_air_is_no_flow():
    """Residuals that correlate, independent of the slopes: as a flow, they would be 0.002 m^2.

    With a flow of 0.02 m^2 over 6 steps besides, that flow is left (seeds 0 to 7, whose values
    scatter by 0.009 m^2: three standard errors of the mean).
    """
    shape = (90, 110)
    alone, uninformed, moved = [], [], []
    for seed in range(8):
        random = np.random.default_rng(seed)
        slope = np.stack([smooth(random, shape, 2.0) for _ in "yz"])
        new = smooth(random, shape, 1.5) * 0.2
        flow = np.stack([smooth(random, shape, 6.0 / np.sqrt(2)) for _ in "yz"]) * np.sqrt(0.02)
        for found, residual in ((alone, new), (moved, new + (slope * flow).sum(0))):
            weight = 1 / np.mean(residual**2)
            g, r = torch.as_tensor(slope), torch.as_tensor(residual)
            products = weight * torch.stack([g[0] ** 2, g[0] * g[1], g[1] ** 2])
            change = of_change(r, weight * g, torch.ones(shape, dtype=torch.bool))
            found.append(model_error(weight * g * r, products, 4.0, change).variance)
            if found is alone:
                uninformed.append(model_error(weight * g * r, products, 4.0).variance)
    assert max(alone) == 0.0 and np.mean(uninformed) > 0.001
    assert np.mean(moved) == pytest.approx(0.02, abs=0.0095)


def linear_fit(shape, seed, number=4, scale=3.0):
    """Slopes g, weights and derivatives of a fit of smooth flows, drawn at random."""
    random = np.random.default_rng(seed)
    g = np.stack([smooth(random, shape, 1.5) for _ in "yz"])
    weight = random.uniform(0.5, 1.5, shape)
    flows = np.stack([smooth(random, shape, scale) for _ in range(2 * number)])
    jacobian = (flows.reshape(number, 2, *shape) * g).sum(1)
    inverse = np.linalg.inv(np.einsum("zy,pzy,qzy->pq", weight, jacobian, jacobian))
    return g, weight, jacobian, inverse


def response_of(g, weight, jacobian, inverse):
    force = weight * jacobian[:, None] * g
    stiffness = weight * np.stack([g[0] ** 2, g[0] * g[1], g[1] ** 2])
    return Response(torch.as_tensor(force), torch.as_tensor(inverse)), torch.as_tensor(stiffness)


@pytest.mark.parametrize("uneven", [False, True])
def test_what_a_fit_absorbs_is_that_of_all_pairs_of_places(uneven):
    """E[q q^T] of a departure before the fit, less that after it, from dense matrices.

    Of forces q as they are, and of forces that count more at some places than at others.
    """
    shape, length = (12, 15), 2.0
    g, weight, jacobian, inverse = linear_fit(shape, 1)
    response, stiffness = response_of(g, weight, jacobian, inverse)
    lags = Lags(shape, stiffness)
    even = np.ones(shape)
    if uneven:
        even = np.random.default_rng(4).uniform(0.2, 1.0, shape)
        response = replace(response, even=torch.as_tensor(even))
        stiffness = torch.as_tensor(even) * stiffness
    (found,) = response.absorbed(stiffness, lags, [length])
    covariance = dense(ModelError((1.0,), (length,)), shape)
    w, j = weight.ravel(), jacobian.reshape(len(jacobian), -1)
    after = np.eye(w.size) - j.T @ inverse @ (j * w)
    lost = np.zeros((w.size, w.size))
    moved = sum(np.outer(part, part) * covariance for part in g.reshape(2, -1))
    left = after @ moved @ after.T
    for part in g.reshape(2, -1):
        counted = even.ravel() * w * part
        lost += np.outer(counted, counted) * (moved - left)
    rows, columns = np.indices(shape).reshape(2, -1)
    for dz, dy in ((0, 0), (1, 0), (2, 3), (4, -5), (0, 6)):
        pairs = (rows[None] - rows[:, None] == dz) & (columns[None] - columns[:, None] == dy)
        expected = lost[pairs].sum()
        assert float(found[dz, dy]) == pytest.approx(expected, abs=2e-3 * lost.trace())


def test_sums_over_squares_are_as_good():
    """On 64 rows and more, from lags of 4 px on: within 1.5 % rms of the sum at no lag."""
    shape = (64, 76)
    g, weight, jacobian, inverse = linear_fit(shape, 2, scale=12.0)
    response, stiffness = response_of(g, weight, jacobian, inverse)
    lags = lags_used(stiffness)
    quick = list(response.absorbed(stiffness, lags, [6.0, 12.0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidar_mi.retrieval.vortices.model_error._LARGE", 1000)
        exact = list(response.absorbed(stiffness, lags, [6.0, 12.0]))
    used = lags.between(4.0)
    for one, other in zip(quick, exact, strict=True):
        assert float(other.take(used).abs().max()) > 0.1 * float(other[0, 0])
        off = (one - other).take(used).square().mean().sqrt()
        assert float(off) < 0.015 * float(other[0, 0])


def test_a_departure_is_found_as_it_was_before_the_fit():
    """16 draws of 0.04 m^2 over 8 steps, of which a fit of long flows absorbs half.

    A draw has 2 x 4900 / (4 pi 64) = 12 independent values less the 12 that are fitted; the mean
    square of 16 draws scatters by about sqrt(2 / 100) = 14 %.
    """
    shape, before, after = (70, 70), [], []
    for seed in range(16):
        random = np.random.default_rng([seed, 7])
        g, weight, jacobian, inverse = linear_fit(shape, seed, 12, 8.0)
        response, stiffness = response_of(g, weight, jacobian, inverse)
        flow = np.stack([smooth(random, shape, 8.0 / np.sqrt(2)) for _ in "yz"]) * 0.2
        residual = (g * flow).sum(0) + 0.05 * random.standard_normal(shape)
        step = inverse @ (jacobian * weight * residual).sum((1, 2))
        residual = residual - np.tensordot(step, jacobian, 1)
        force = torch.as_tensor(weight * g * residual)
        after.append(model_error(force, stiffness, 4.0).variance)
        before.append(model_error(force, stiffness, 4.0, response=response).variance)
    assert np.mean(after) < 0.032
    assert np.mean(before) == pytest.approx(0.04, rel=0.42)
