"""Quadratic forms of a flow's coefficients and their inverse, against dense matrices.

Detects a wrong block, shift or derivative.
"""

import torch

from lidar_mi.retrieval.velocimetry.band import Band
from lidar_mi.retrieval.velocimetry.block_tridiagonal import factor
from lidar_mi.retrieval.velocimetry.flow_spline import Axis, Mesh

AXES = Axis(23, 4.0), Axis(38, 5.0)


def pixels():
    return [torch.arange(axis.size, dtype=torch.float64) for axis in AXES]


def test_block_tridiagonal_is_its_dense_matrix():
    random = torch.Generator().manual_seed(1)
    parts = torch.randn(4, 5, 5, generator=random, dtype=torch.float64)
    below = torch.randn(3, 5, 5, generator=random, dtype=torch.float64)
    diagonal = parts @ parts.mT + 20 * torch.eye(5, dtype=torch.float64)
    dense = torch.block_diag(*diagonal)
    for k in range(3):
        dense[5 * k + 5 : 5 * k + 10, 5 * k : 5 * k + 5] = below[k]
        dense[5 * k : 5 * k + 5, 5 * k + 5 : 5 * k + 10] = below[k].T
    root = factor(diagonal, below)
    right = torch.randn(4, 5, 2, generator=random, dtype=torch.float64)
    solution = torch.linalg.solve(dense, right.reshape(20, 2))
    torch.testing.assert_close(root.solve(right).reshape(20, 2), solution)
    inverse = torch.linalg.inv(dense)
    own, under = root.inverse()
    for k in range(4):
        torch.testing.assert_close(own[k], inverse[5 * k : 5 * k + 5, 5 * k : 5 * k + 5])
    for k in range(3):
        torch.testing.assert_close(under[k], inverse[5 * k + 5 : 5 * k + 10, 5 * k : 5 * k + 5])


def test_forms_solutions_and_covariances_are_those_of_the_dense_matrix():
    knots = Band(*AXES)
    mesh = Mesh(AXES, pixels())
    random = torch.Generator().manual_seed(2)
    slope = torch.randn(2, 23, 38, generator=random, dtype=torch.float64)
    weight = torch.rand(23, 38, generator=random, dtype=torch.float64)
    band = knots.form(slope[:, None] * slope, mesh)
    bend = knots.form(weight, mesh, (1, 1), (1, 1))
    for a in (0, 1):
        band[a, a] += bend
    plain, twist = (torch.kron(mesh.basis(0, k), mesh.basis(1, k)) for k in (0, 1))
    rows = torch.cat([part.flatten()[:, None] * plain for part in slope], 1)
    side = twist.T @ (weight.flatten()[:, None] * twist)
    dense = rows.T @ rows + torch.block_diag(side, side)
    some = torch.randn((2, AXES[0].knots, AXES[1].knots), generator=random, dtype=torch.float64)
    torch.testing.assert_close(knots.apply(band, some).flatten(), dense @ some.flatten())
    dense += 0.1 * torch.eye(len(dense), dtype=torch.float64)
    for a in (0, 1):
        band[a, a, 3, :, 0] += 0.1
    root = knots.factor(band)
    torch.testing.assert_close(
        knots.solve(root, some).flatten(), torch.linalg.solve(dense, some.flatten())
    )
    inverse = torch.linalg.inv(dense).unflatten(0, (2, -1)).unflatten(2, (2, -1))
    places = torch.tensor([0.0, 3.3, 21.5]), torch.tensor([2.0, 17.7, 36.9, 37.0])
    few = Mesh(AXES, [place.double() for place in places])
    at = torch.kron(few.basis(0), few.basis(1))
    spread = knots.spread(knots.covariance(root), few)
    for a in (0, 1):
        for b in (0, 1):
            expected = (at @ inverse[a, :, b] @ at.T).diagonal().reshape(3, 4)
            torch.testing.assert_close(spread[a, b], expected)
