"""What images say on a flow: paths that are arcs, noise from what still images differ by.

Detects a path that is no arc, a noise that is wrong by a tenth, a gradient that is not that of the
misfit.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import linearised, path, prepared
from lidar_mi.retrieval.flow.settings import VOLUME_VARIATIONAL, VariationalSettings
from lidar_mi.retrieval.images.spline import filtered_spline
from tests.support.flows import plane_waves, texture
from tests.support.volumes import nodes, random_waves

AXES = Axis(23, 4.0), Axis(38, 5.0)


def pixels():
    return [torch.arange(axis.size, dtype=torch.float64) for axis in AXES]


def test_paths_in_a_solid_rotation_are_arcs():
    mesh = Mesh(AXES, pixels())
    z, y = mesh.places[0][:, None] - 11, mesh.places[1] - 18.5
    turn = 0.9
    flow = torch.stack([turn * y + 0 * z, -turn * z + 0 * y])
    time = torch.tensor([-0.5, 0.25, 0.5], dtype=torch.float64)
    found = path(mesh, mesh.fitted(flow), time, 6)
    for k, t in enumerate(time):
        cosine, sine = torch.cos(turn * t), torch.sin(turn * t)
        limit = 25 * (turn * abs(float(t))) ** 7 / 5040 + 3e-3
        assert (found[0, k] - 11 - cosine * z - sine * y).abs().max() < limit
        assert (found[1, k] - 18.5 - cosine * y + sine * z).abs().max() < limit


def test_paths_in_a_volume_are_helices():
    """A drift along x and a rotation about it."""
    axes = [Axis(n, 3.0) for n in (8, 15, 15)]
    mesh = Mesh(axes, [torch.arange(axis.size, dtype=torch.float64) for axis in axes])
    x, z, y = torch.meshgrid(*(p - p.mean() for p in mesh.places), indexing="ij")
    turn = 0.6
    flow = torch.stack([0.4 + 0 * x, turn * y, -turn * z])
    for t in (-0.5, 0.5):
        found = path(mesh, mesh.fitted(flow), torch.tensor([t], dtype=torch.float64), 6)[:, 0]
        angle = torch.tensor(turn * t)
        c, s = torch.cos(angle), torch.sin(angle)
        arc = torch.stack([x + 0.4 * t, c * z + s * y, c * y - s * z])
        off = found - torch.stack([p.mean() for p in mesh.places])[:, None, None, None] - arc
        assert float(off.abs().max()) < 3e-3


@pytest.mark.parametrize(("number", "spread"), [(2, 0.028), (3, 0.016), (20, 0.0075)])
def test_noise_of_a_burst_is_the_difference_of_images_at_rest(number, spread):
    """The variance to 4 times its relative spread over textures and noises of 12 seeds."""
    random = np.random.default_rng(8)
    z, y = np.arange(80), np.arange(90)
    still = texture(plane_waves(8, 3.0), *np.meshgrid(y, z))
    stack = [
        torch.tensor(still + 0.05 * random.standard_normal(still.shape)) for _ in range(number)
    ]
    settings = VariationalSettings()
    # told too little noise, the fit has to take it from the misfit
    images = prepared(stack, 0.02, 0.0, settings)
    axes = [Axis(n, 10.0) for n in still.shape]
    mesh = Mesh(axes, [torch.arange(n, dtype=torch.float64) for n in still.shape])
    nothing = torch.zeros(2, *(axis.knots for axis in axes), dtype=torch.float64)
    found = linearised(images, mesh, nothing, settings)
    assert found.variance == pytest.approx(0.05**2, rel=4 * spread)


def test_gradient_is_that_of_the_misfit_of_volumes():
    """By differences of the log-likelihood, for a shift of everything along z."""
    shape, moved = (14, 16, 18), 0.4
    pattern, shift = random_waves(1), np.array([0.0, 0.4, 0.0])[:, None, None, None]
    stack = [
        torch.tensor(pattern(nodes(shape) - t * shift), dtype=torch.float32) for t in (-0.5, 0.5)
    ]
    images = prepared(stack, 0.3, 0.0, VOLUME_VARIATIONAL)
    axes = [Axis(n, 5.0) for n in shape]
    mesh = Mesh(axes, [torch.arange(n, dtype=torch.float32) for n in shape])
    inner = torch.zeros(shape)
    inner[3:-3, 3:-3, 3:-3] = 1

    def about(z):
        flow = torch.zeros(3, *mesh.shape)
        flow[1] = z
        linear = linearised(images, mesh, mesh.fitted(flow), VOLUME_VARIATIONAL)
        rest = ((linear.warped - linear.warped.mean(0)) * inner).double()
        return float((linear.gradient[1] * inner).sum()), rest.square().sum() / linear.variance

    gradient, _ = about(moved - 0.2)
    # what misfits is none of the noise's, but no larger than three standard deviations
    above, below = (float(about(moved - off)[1]) for off in (0.15, 0.25))
    assert gradient == pytest.approx((below - above) / 2 / 0.1, rel=0.05)
    at_truth, _ = about(moved)
    assert abs(at_truth) < 0.03 * gradient


def test_slopes_of_noise_are_those_of_filtered_noise():
    """Mean square over 8 pairs of images of noise alone, to 4 of its standard errors."""
    random = np.random.default_rng(6)
    z, y = np.arange(90), np.arange(100)
    still = texture(plane_waves(6, 3.0), *np.meshgrid(y, z))

    def stack(level):
        return [
            torch.as_tensor(level * still + 0.1 * random.standard_normal(still.shape))
            for _ in range(2)
        ]

    images = prepared(stack(1.0), 0.1, 0.0, VariationalSettings())
    spline = images.smooth
    place = torch.meshgrid(*(torch.arange(8.0, n - 8) for n in still.shape), indexing="ij")
    place = [axis.double().expand(2, -1, -1) for axis in place]
    found = []
    for _ in range(8):
        noise = filtered_spline(torch.stack(stack(0.0)), images.chosen.of_slopes(), spline.settings)
        _, *slopes = noise.sample(*place)
        found.append(sum(float(slope.mean(0).square().mean()) for slope in slopes))
    mean, error = np.mean(found), np.std(found, ddof=1) / len(found) ** 0.5
    assert abs(mean - spline.noisy_slopes) < 4 * error + 0.01 * mean


def test_where_there_is_no_texture_images_tell_nothing():
    """A half of the image is dark: slopes of noise there do not count as those of the air."""
    random = np.random.default_rng(7)
    z, y = np.arange(80), np.arange(120)
    still = (y > 60) * (texture(plane_waves(7, 3.0), *np.meshgrid(y, z), 0.3) - 1)
    stack = [torch.as_tensor(still + 0.05 * random.standard_normal(still.shape)) for _ in "12"]
    images = prepared(stack, 0.05, 0.0, VariationalSettings())
    axes = [Axis(n, 4.0) for n in still.shape]
    mesh = Mesh(axes, [torch.arange(n, dtype=torch.float64) for n in still.shape])
    nothing = torch.zeros(2, *(axis.knots for axis in axes), dtype=torch.float64)
    found = linearised(images, mesh, nothing, VariationalSettings())
    told = found.weight * found.slope.square().sum(0)
    _, _, *slopes = images.sample(*path(mesh, nothing, images.time, 1))
    seems = found.weight * torch.stack([slope.mean(0) for slope in slopes]).square().sum(0)
    dark, bright = np.s_[10:-10, 10:45], np.s_[10:-10, 75:-10]
    assert float(told[dark].sum()) < 0.1 * float(seems[dark].sum())
    assert float(told[bright].sum()) > 0.5 * float(seems[bright].sum())


def test_a_noise_far_below_that_of_the_spectra_is_a_lower_limit():
    """Noise of 0, and of a thousandth of the texture, of images that differ by 5 % of it."""
    random = np.random.default_rng(5)
    air = gaussian_filter(random.standard_normal((80, 100)), 1.0, mode="wrap")
    air = torch.as_tensor(air / air.std())
    images = [air + 0.05 * torch.as_tensor(random.standard_normal(air.shape)) for _ in range(2)]
    settings = VariationalSettings()
    none = prepared(images, None, 0.0, settings)
    assert abs(none.noise / 0.05 - 1) < 0.15
    for told in (0.0, 1e-3):
        found = prepared(images, told, 0.0, settings)
        assert (found.noise, found.known_noise, found.noise_known) == (none.noise, told, False)
    given = prepared(images, 0.04, 0.0, settings)
    assert (given.noise, given.known_noise, given.noise_known) == (0.04, 0.04, True)
