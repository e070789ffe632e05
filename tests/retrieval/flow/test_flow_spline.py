"""Splines of a flow against polynomials they hold exactly.

Detects a wrong knot, derivative or axis, and a transpose that is not one.
"""

import pytest
import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, halves, interpolated

AXES = Axis(23, 4.0), Axis(38, 5.0)


def pixels():
    return [torch.arange(axis.size, dtype=torch.float64) for axis in AXES]


def test_splines_hold_cubics_and_their_derivatives():
    mesh = Mesh(AXES, pixels())
    z, y = mesh.places[0][:, None] / 10, mesh.places[1] / 10
    flow = torch.stack([z**3 * y - z * y**2, 2 * z**2 + y**3])
    coefficients = mesh.fitted(flow)
    torch.testing.assert_close(mesh.field(coefficients), flow, atol=1e-4, rtol=1e-4)
    slope = torch.stack([3 * z**2 * y - y**2, 4 * z + 0 * y]) / 10
    found = mesh.field(coefficients, (1, 0))
    torch.testing.assert_close(found, slope, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("sizes", [(23, 38), (9, 11, 14)])
def test_slopes_are_those_of_polynomials_and_have_their_transpose(sizes):
    """A product of the coordinates' squares; <slopes of c, f> = <c, transpose of f>."""
    axes = [Axis(n, 3.0) for n in sizes]
    mesh = Mesh(axes, [torch.linspace(0.2, n - 1, 2 * n, dtype=torch.float64) for n in sizes])
    at = torch.meshgrid(*(p / 10 for p in mesh.places), indexing="ij")
    flow = torch.stack([part**2 for part in at]).prod(0)[None]
    for axis, slope in enumerate(mesh.slopes(mesh.fitted(flow))):
        torch.testing.assert_close(slope, flow * 0.2 / at[axis], atol=1e-3, rtol=1e-3)
    random = torch.Generator().manual_seed(0)
    c = torch.randn(3, *(a.knots for a in axes), generator=random, dtype=torch.float64)
    f = torch.randn(len(sizes), 3, *mesh.shape, generator=random, dtype=torch.float64)
    for axis, slope in enumerate(mesh.slopes(c)):
        order = tuple(int(a == axis) for a in range(len(sizes)))
        right = (c * mesh.transposed(f[axis], order)).sum()
        torch.testing.assert_close((slope * f[axis]).sum(), right)


def test_halves_lie_between_the_knots_and_linear_fields_between_them():
    mesh = halves(AXES, torch.zeros(0, dtype=torch.float64))
    assert mesh.shape == (2 * AXES[0].cells, 2 * AXES[1].cells)
    known = torch.stack(torch.meshgrid(*mesh.places, indexing="ij"))
    places = torch.tensor([3.0, 7.7]).double(), torch.tensor([5.0, 20.2]).double()
    found = interpolated(known, mesh.places, places)
    torch.testing.assert_close(found, torch.stack(torch.meshgrid(*places, indexing="ij")))
