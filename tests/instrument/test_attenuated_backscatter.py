"""Apparent backscatter undoes the lidar equation. Detects an error of 2e-5."""

import math

import numpy as np
import pytest

from lidar_mi.instrument.attenuated_backscatter import attenuated_backscatter
from lidar_mi.instrument.scan import ScanPlan


@pytest.mark.parametrize("kind", ["planar", "spherical"])
@pytest.mark.parametrize("count", [1, 4])
def test_environment_alone_gives_its_backscatter_coefficient(kind, count):
    """S0 = A beta exp(-2 alpha r) / r^2, integrated over each gate along each beam.

    The formula takes the integrand at the gate's middle: (dr / r)^2 / 4 = 6e-6 off.
    """
    y, z = np.linspace(-55, 55, 7), np.linspace(-35, 35, 5)
    plan = ScanPlan(y, z, 500.0, 502.5, kind, count, 0.0)
    beta, alpha, area = 3e-6, 1e-4, math.pi * 0.25
    slant = 1.0
    if kind == "planar":
        slant = np.sqrt(1 + (y / 501.25) ** 2 + (z[:, None] / 501.25) ** 2)
    edges = np.linspace(500, 502.5, count + 1)[:, None, None] * np.broadcast_to(slant, (5, 7))
    r = edges[:-1] + np.linspace(0, 1, 1001)[:, None, None, None] * np.diff(edges, axis=0)
    s0 = np.trapezoid(area * beta * np.exp(-2 * alpha * r) / r**2, r, axis=0)
    found = attenuated_backscatter(s0, plan, area, alpha)
    assert found.shape == (count, 5, 7)
    assert found == pytest.approx(beta, rel=2e-5)
