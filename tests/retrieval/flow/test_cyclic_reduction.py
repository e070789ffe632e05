"""Cyclic reduction of a flow's quadratic form, against dense matrices and against LAPACK.

Detects a block that is eliminated twice or not at all, numbers of blocks that do not halve, answers
that a device is asked for one after the other, and winds that depend on which factor is used.
"""

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lidar_mi.retrieval.flow import cyclic_reduction, direct
from lidar_mi.retrieval.flow.band import Band, form
from lidar_mi.retrieval.flow.band_cholesky import cholesky
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.next_flow import next_flow
from lidar_mi.retrieval.flow.prior import first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.flow.variational import variational, variational_and_flow
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows
from tests.support.flows import axes, plane_waves, texture


class Answers(TorchDispatchMode):
    """Counts what a computer waits for: numbers that it reads, sizes that depend on values."""

    number = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        waits = func in (
            torch.ops.aten._local_scalar_dense.default,
            torch.ops.aten.nonzero.default,
            torch.ops.aten.masked_select.default,
        )
        if func in (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default):
            waits = any(i is not None and i.dtype == torch.bool for i in args[1])
        self.number += waits
        return func(*args, **(kwargs or {}))


def positive_form(cells, seed):
    """A form of some cells along y, of slopes and a ridge; its dense matrix, from unit vectors."""
    shape = Axis(9, 4.0), Axis(4 * cells + 1, 4.0)
    pixels = [torch.arange(axis.size, dtype=torch.float64) for axis in shape]
    random = torch.Generator().manual_seed(seed)
    slope = torch.randn(2, *(len(place) for place in pixels), generator=random).double()
    band = form(slope[:, None] * slope, Mesh(shape, pixels))
    for a in (0, 1):
        band[a, a, 3, :, 0] += 0.3
    knots = Band(*(axis.knots for axis in shape))
    units = torch.eye(2 * knots.rows * knots.columns, dtype=torch.float64)
    units = units.reshape(-1, 2, knots.rows, knots.columns)
    return band, torch.stack([knots.apply(band, unit).flatten() for unit in units])


# 4 to 27 knots: 2 to 9 blocks, whole and not, even and odd in every round
@pytest.mark.parametrize("cells", [1, 2, 3, 4, 6, 7, 10, 13, 17, 24])
def test_solution_and_inverse_are_those_of_the_dense_matrix(cells):
    band, dense = positive_form(cells, cells)
    root = cyclic_reduction.factored(torch.stack([2 * band, band]))[1]
    random = torch.Generator().manual_seed(2)
    right = torch.randn(3, 2, *(band.shape[k] for k in (3, 5)), generator=random).double()
    found = root.solve(right).flatten(1)
    torch.testing.assert_close(found, torch.linalg.solve(dense, right.flatten(1).T).T)
    torch.testing.assert_close(root.solve(right[1]).flatten(), found[1])
    # the inverse times unit vectors within the band; `apply` holds the rest for 0
    inverse, rows, columns = torch.linalg.inv(dense), band.shape[3], band.shape[5]
    inverse = inverse.reshape(2, rows, columns, 2, rows, columns)
    covariance = root.covariance()
    for z in range(rows):
        for shift_z in range(max(-3, -z), min(3, rows - 1 - z) + 1):
            for shift_y in range(min(4, columns)):
                expected = inverse[:, z, :, :, z + shift_z].diagonal(shift_y, 1, 3)
                part = covariance[:, :, 3 + shift_z, z, shift_y, : columns - shift_y]
                torch.testing.assert_close(part, expected)
    torch.testing.assert_close(covariance, cholesky(band).covariance() * (covariance != 0))


def test_one_answer_is_waited_for():
    band, _ = positive_form(17, 3)
    right = torch.ones(2, *(band.shape[k] for k in (3, 5)), dtype=torch.float64)
    with Answers() as asked:
        for root in cyclic_reduction.factored(torch.stack([band, 2 * band])):
            root.solve(right)
            root.covariance()
    assert asked.number == 1


def moving_texture():
    y, z = axes(72, 56)
    grid = np.meshgrid(y, z)
    waves, noise = plane_waves(1, 3.0, 0.5), np.random.default_rng(1)
    return [
        torch.from_numpy(texture(waves, grid[0] - x, grid[1]) + 0.01 * noise.normal(size=(56, 72)))
        for x in (0.0, 0.7)
    ]


def test_an_iteration_waits_for_one_answer(monkeypatch):
    """Whether the factors are there; the likelihood, the evidence and the prior ask for nothing."""
    monkeypatch.setattr(direct, "by_lapack", lambda form: False)
    settings, stack = VariationalSettings(), moving_texture()
    images = prepared(stack, None, 0.0, settings)
    shape = [Axis(n, 4.0) for n in stack[0].shape]
    mesh = Mesh(shape, [torch.arange(n).double() for n in stack[0].shape])
    coefficients = torch.full((2, *(axis.knots for axis in shape)), 0.1).double()
    prior = first_prior(shape, coefficients, 5.0, (1.0, 1.0), settings)

    def iteration(coefficients, prior):
        linear = linearised(images, mesh, coefficients, settings)
        posterior = direct.solved(linear, mesh, coefficients, prior, settings, 0)
        return posterior.coefficients, prior.updated(*posterior.evidence(), settings)

    # splines and groups of a mesh are made once
    coefficients, prior = iteration(coefficients, prior)
    with Answers() as asked:
        iteration(coefficients, prior)
    assert asked.number == 1


def agree(found, expected):
    deviation = expected.covariance.diagonal().sqrt().movedim(-1, 0)
    assert float(((found.d - expected.d) / deviation).abs().max()) < 1e-3
    # of both components over their standard errors: a covariance of them may be next to 0
    product = deviation[:, None] * deviation
    change = (found.covariance - expected.covariance) / product
    assert float(change.abs().max()) < 1e-3
    assert torch.equal(found.flag, expected.flag)


def test_a_form_that_is_not_positive_has_no_factor():
    band, _ = positive_form(5, 1)
    with pytest.raises(torch.linalg.LinAlgError, match="not positive definite"):
        cyclic_reduction.factored(torch.stack([band, -band]))


def test_winds_are_those_of_lapack(monkeypatch):
    """The flow, its errors and the next flow by either factor, to 1e-3 of a standard error."""
    images = moving_texture()
    windows = Windows(tuple(images[0].shape), 8, 16, 4)

    def found():
        first, flow = variational_and_flow(images, windows, noise=0.01, keep=True)
        return first, next_flow(flow, images, 0.01, 0.5)[0]

    expected = found()
    monkeypatch.setattr(direct, "by_lapack", lambda form: False)
    for one, other in zip(found(), expected, strict=True):
        agree(one, other)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_winds_are_those_of_the_processor():
    images = moving_texture()
    found = variational(*(image.cuda() for image in images), stride=4, noise=0.01)
    agree(
        Displacement(*(part.cpu() for part in found[:4])),
        variational(*images, stride=4, noise=0.01),
    )
