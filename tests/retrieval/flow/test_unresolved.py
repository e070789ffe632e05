"""Variance of motion that splines leave, against what they leave of flows that are known.

Detects turbulence that counts for nothing, a spectrum extrapolated with another law, and smooth
flow that is taken for turbulence.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortex import velocity, vortex_pair
from lidar_mi.retrieval.flow import direct
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.prior import first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.flow.unresolved import flows_of_noise, unresolved_variance
from tests.support.flows import axes, plane_waves, texture

KNOTS = 4.0


def left(flow):
    """Mean square that splines of these knots leave of a flow, by numpy's least squares."""
    rows, columns = (Axis(n, KNOTS).basis(torch.arange(n).double()).numpy() for n in flow.shape[1:])
    of_rows, of_columns = (basis @ np.linalg.pinv(basis) for basis in (rows, columns))
    return np.mean([(part - of_rows @ part @ of_columns.T) ** 2 for part in flow.numpy()])


def resolved(flow):
    """What the splines hold of it."""
    places = [torch.arange(n).double() for n in flow.shape[1:]]
    mesh = Mesh([Axis(n, KNOTS) for n in flow.shape[1:]], places)
    return mesh.field(mesh.fitted(flow))


def turbulence(seed, size=256):
    """Two components of a periodic plane, px in dt: a plane of turbulence has k^(-8/3) in it."""
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    amplitude = np.where(k > 0, np.maximum(k, 1 / size), np.inf) ** (-4 / 3)
    random = np.random.default_rng(seed)
    noise = np.fft.rfft2(random.standard_normal((2, size, size)))
    field = np.fft.irfft2(amplitude * noise)
    return torch.as_tensor(field / field.std())


def test_of_turbulence():
    """Spectral density k^(-5/3): 30 % of what splines leave, from what they hold alone."""
    for seed in (1, 2):
        flow = turbulence(seed)
        found = float(unresolved_variance(resolved(flow), KNOTS).mean())
        assert abs(math.log(found / left(flow))) < math.log(1.7)


@pytest.mark.parametrize("core_radius", [2.0, 3.0, 5.0])
def test_of_a_smooth_vortex_pair(core_radius):
    """No turbulence: about what splines leave, and nearly nothing outside (0.025 m/s)."""
    y, z = axes(219, 139)
    grid = np.meshgrid(y, z)
    v, w = velocity(vortex_pair(400.0, separation=47.1, core_radius=core_radius), *grid)
    flow = torch.as_tensor(np.stack([w, v])) * 0.1 / 0.5
    found = unresolved_variance(resolved(flow), KNOTS)
    assert 0.3 < float(found.mean()) / left(flow) < 2
    outside = np.minimum(*(np.hypot(grid[0] - s * 47.1 / 2, grid[1]) for s in (1, -1))) > 12
    assert float(found[torch.as_tensor(outside)].mean().sqrt()) < 5e-3


def test_of_a_flow_that_splines_hold():
    y = torch.arange(64).double()
    shear = torch.stack([0 * y + 0.3, 0.05 * y])[:, None].expand(-1, 48, -1).contiguous()
    assert float(unresolved_variance(shear, KNOTS).max()) < 1e-9


def test_what_noise_makes_is_no_motion():
    """Still air and white noise: octaves of the flow are those of draws of the same noise.

    What is left of their difference, once clipped at 0, is below a third of what the flow of noise
    would be extrapolated to: octaves scatter by a fifth at each place.
    """
    random = np.random.default_rng(7)
    air = texture(plane_waves(7, 3.0, 0.5), *np.meshgrid(*axes(120, 90)))
    level = 0.03
    images = [torch.as_tensor(air + level * random.standard_normal(air.shape)) for _ in "12"]
    settings = VariationalSettings()
    pair = prepared(images, level, 0.0, settings)
    grid = [Axis(n, KNOTS) for n in air.shape]
    mesh = Mesh(grid, [torch.arange(n).double() for n in air.shape])
    still = torch.zeros(2, *(axis.knots for axis in grid), dtype=torch.float64)
    # a prior that holds back little
    prior = first_prior(grid, still, 6.0, (1.0, 1.0), replace(settings, least_vorticity=0.1))
    linear = linearised(pair, mesh, still, settings)
    posterior = direct.solved(linear, mesh, still, prior, settings, 0)
    flow = mesh.field(posterior.coefficients)
    noise = flows_of_noise(linear, mesh, posterior.response)
    ratio = float(noise.square().mean() / flow.square().mean())
    assert abs(np.log(ratio)) < np.log(1.3)
    left, all_of_it = (
        float(unresolved_variance(flow, KNOTS, None, part).mean()) for part in (noise, None)
    )
    assert left < all_of_it / 3
