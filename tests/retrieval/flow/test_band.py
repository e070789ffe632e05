"""Quadratic forms of a flow's coefficients and their inverse, against dense matrices.

Detects a wrong block, shift or derivative.
"""

import pytest
import torch

from lidar_mi.retrieval.flow.band import Band, form, spread
from lidar_mi.retrieval.flow.band_cholesky import cholesky, factored, solved_near
from lidar_mi.retrieval.flow.direct import covariance_near
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh

AXES = Axis(23, 4.0), Axis(38, 5.0)


def pixels():
    return [torch.arange(axis.size, dtype=torch.float64) for axis in AXES]


def test_forms_solutions_and_covariances_are_those_of_the_dense_matrix():
    knots = Band(*(axis.knots for axis in AXES))
    mesh = Mesh(AXES, pixels())
    random = torch.Generator().manual_seed(2)
    slope = torch.randn(2, 23, 38, generator=random, dtype=torch.float64)
    weight = torch.rand(23, 38, generator=random, dtype=torch.float64)
    band = form(slope[:, None] * slope, mesh)
    bend = form(weight, mesh, (1, 1), (1, 1))
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
    inverse = torch.linalg.inv(dense).unflatten(0, (2, -1)).unflatten(2, (2, -1))
    places = torch.tensor([0.0, 3.3, 21.5]), torch.tensor([2.0, 17.7, 36.9, 37.0])
    few = Mesh(AXES, [place.double() for place in places])
    at = torch.kron(few.basis(0), few.basis(1))
    alone = cholesky(band)
    torch.testing.assert_close(
        alone.solve(some).flatten(), torch.linalg.solve(dense, some.flatten())
    )
    several = torch.stack([some, some.flip(-1), 2 * some])
    solved = torch.linalg.solve(dense, several.flatten(1).T).T
    torch.testing.assert_close(alone.solve(several).flatten(1), solved)
    products = knots.apply(band, several).flatten(1)
    torch.testing.assert_close(products, several.flatten(1) @ dense)
    of_band = spread(alone.covariance(), few)
    for a in (0, 1):
        for b in (0, 1):
            expected = (at @ inverse[a, :, b] @ at.T).diagonal().reshape(3, 4)
            torch.testing.assert_close(of_band[a, b], expected)
    # from the factor of another form, which is no longer asked for more than it is worth
    similar = cholesky(1.3 * band)
    changed = band + 0.2 * band * (band > 0)
    near = solved_near(similar, changed, some, 1e-9, 100)
    torch.testing.assert_close(near, cholesky(changed).solve(some), rtol=1e-6, atol=1e-9)
    assert solved_near(similar, changed, some, 1e-9, 1) is None


def test_a_form_that_is_not_positive_has_no_factor():
    mesh = Mesh(AXES, pixels())
    band = form(-torch.ones(2, 2, 23, 38, dtype=torch.float64), mesh)
    assert cholesky(band) is None
    with pytest.raises(torch.linalg.LinAlgError, match="not positive definite"):
        factored(band[None])


def test_a_covariance_is_of_single_precision_only_where_that_suffices():
    """Degrees of freedom of each coefficient to 1e-3; a form that is stiffer by 1e10 in part."""
    knots = Band(*(axis.knots for axis in AXES))
    mesh = Mesh(AXES, pixels())
    band = torch.zeros(2, 2, 7, knots.rows, 4, knots.columns, dtype=torch.float64)
    plain = form(torch.ones(23, 38, dtype=torch.float64), mesh)
    stiff = form(torch.ones(23, 38, dtype=torch.float64), mesh, (1, 1), (1, 1))
    for strength, same in ((1.0, False), (1e10, True)):
        for a in (0, 1):
            band[a, a] = plain + strength * stiff
            band[a, a, 3, :, 0] += 0.1
        root = cholesky(band)
        exact, found = root.covariance(), covariance_near(root, band)
        assert torch.equal(found, exact) == same
        ones = torch.ones(2, knots.rows, knots.columns, dtype=torch.float64)
        torch.testing.assert_close(knots.apply(found * band, ones), ones, rtol=0, atol=1e-3)
