"""The solver of volumes against dense matrices.

Detects a transpose that is not one, a system that is not solved, draws of another covariance.
"""

import numpy as np
import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, halves
from lidar_mi.retrieval.flow.iterative import conjugate_gradients, solved
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import (
    VOLUME_VARIATIONAL,
    IterativeSettings,
    VariationalSettings,
)


def test_conjugate_gradients_solve_a_dense_system():
    random = torch.Generator().manual_seed(1)
    root = torch.randn(20, 20, generator=random, dtype=torch.float64)
    matrix = root @ root.T + torch.eye(20, dtype=torch.float64)
    right = torch.randn(3, 20, generator=random, dtype=torch.float64)
    inverse = 1 / matrix.diagonal()
    found = conjugate_gradients(lambda c: c @ matrix, right, lambda c: c * inverse, 1e-10, 200)
    torch.testing.assert_close(found, torch.linalg.solve(matrix, right.T).T)


def case():
    """A tiny volume of slopes and weights, and a prior of unlike strengths, in float64."""
    shape = (5, 6, 7)
    random = torch.Generator().manual_seed(2)
    axes = [Axis(n, 4.0) for n in shape]
    mesh = Mesh(axes, [torch.arange(n, dtype=torch.float64) for n in shape])
    slope = torch.randn(3, *shape, generator=random, dtype=torch.float64)
    gradient = torch.randn(3, *shape, generator=random, dtype=torch.float64)
    weight = torch.rand(shape, generator=random, dtype=torch.float64) + 0.5
    linear = Linear(slope, gradient, weight, 1.0, slope, slope, weight > 0, torch.ones_like(weight))
    nodes = halves(axes, weight)
    local = torch.rand(3, *nodes.shape, generator=random, dtype=torch.float64) + 0.1
    prior = Prior(local, nodes, 2.0, (0.5, 0.7, 1.1))
    return linear, mesh, prior


def dense(linear, mesh, prior, ridge):
    """Matrices of the data and of the prior, column by column of unit coefficients."""
    shape = 3, *(axis.knots for axis in mesh.axes)
    size = int(np.prod(shape))
    units = torch.eye(size, dtype=torch.float64).reshape(size, *shape)
    along = (mesh.field(units) * linear.slope).sum(1).flatten(1)
    data = (along * linear.weight.flatten()) @ along.T
    rates = prior.rates(units).flatten(1)
    stiff = (rates * prior.weights.flatten()) @ rates.T
    return data, stiff + ridge * torch.eye(size, dtype=torch.float64)


SETTINGS = VariationalSettings(ridge=1e-2, solver=IterativeSettings(tolerance=1e-9, steps=2000))


def test_a_step_is_that_of_the_dense_matrix():
    linear, mesh, prior = case()
    data, stiff = dense(linear, mesh, prior, SETTINGS.ridge)
    start = torch.zeros(3, *(axis.knots for axis in mesh.axes), dtype=torch.float64)
    start[1] += 0.3
    found = solved(linear, mesh, start, prior, SETTINGS, 0).coefficients
    right = mesh.transposed(linear.gradient).flatten() - stiff @ start.flatten()
    expected = start.flatten() + torch.linalg.solve(data + stiff, right)
    torch.testing.assert_close(found.flatten(), expected, atol=1e-6, rtol=1e-6)


def test_rates_have_their_transpose_and_know_a_rotation():
    """<rates of c, f> = <c, transpose of f>; a rotation about x by 0.3 is a vorticity of 0.6."""
    _, mesh, prior = case()
    random = torch.Generator().manual_seed(0)
    c = torch.randn(3, *(a.knots for a in mesh.axes), generator=random, dtype=torch.float64)
    f = torch.randn(4, *prior.mesh.shape, generator=random, dtype=torch.float64)
    torch.testing.assert_close((prior.rates(c) * f).sum(), (c * prior.rates_transposed(f)).sum())
    z, y = mesh.places[1][:, None] * 0.7, mesh.places[2] * 1.1
    flow = torch.stack([0 * z * y, 0.3 * y / 0.7 + 0 * z, -0.3 * z / 1.1 + 0 * y])
    flow = flow[:, None].expand(-1, len(mesh.places[0]), -1, -1).contiguous()
    found = prior.rates(mesh.fitted(flow))
    torch.testing.assert_close(found[0].abs(), torch.full_like(found[0], 0.6), atol=1e-3, rtol=0)
    assert float(found[1:].abs().max()) < 1e-3


def test_draws_have_the_posterior_covariance():
    """The trace of what is lumped to the mesh: 256 draws tell it to some 3 %."""
    linear, mesh, prior = case()
    settings = VariationalSettings(
        ridge=1e-2, solver=IterativeSettings(loose=1e-5, steps=500, final_draws=256)
    )
    posterior = solved(
        linear, mesh, torch.zeros(3, *(a.knots for a in mesh.axes)).double(), prior, settings, 0
    )
    places = [torch.arange(1.0, axis.size - 1).double() for axis in mesh.axes]
    found, before = posterior.covariance(places)
    assert bool(before.isinf().all())
    nodes = prior.mesh
    units = torch.eye(posterior.coefficients.numel(), dtype=torch.float64)
    fields = nodes.field(units.reshape(-1, *posterior.coefficients.shape))
    curvature = torch.einsum("mapqr,abpqr,nbpqr->mn", fields, posterior.curvature, fields)
    _, stiff = dense(linear, mesh, prior, settings.ridge)
    inverse = torch.linalg.inv(curvature + stiff)
    spread = torch.einsum("mapqr,mn,nbpqr->abpqr", fields, inverse, fields)
    mean = prior.smooth(spread).mean((2, 3, 4))
    torch.testing.assert_close(found.mean((2, 3, 4)), mean, rtol=0.15, atol=0.1 * float(mean.max()))


def test_the_same_draws_in_every_run():
    linear, mesh, prior = case()
    start = torch.zeros(3, *(a.knots for a in mesh.axes)).double()
    places = [torch.arange(1.0, axis.size - 1).double() for axis in mesh.axes]
    one, other = (
        solved(linear, mesh, start, prior, VOLUME_VARIATIONAL, 1).covariance(places) for _ in "ab"
    )
    assert torch.equal(one[0], other[0])
