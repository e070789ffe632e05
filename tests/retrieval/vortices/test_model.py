"""The flow of two vortices: unit tests against differences and closed forms. Detect a wrong sign,
factor or profile, and paths bent the wrong way or left straight."""

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity, vortex_pair
from lidar_mi.retrieval.vortices.model import (
    PARAMETERS,
    PROFILES,
    _followed,
    advected,
    drift,
    gradient,
    path_sensitivity,
    rotations,
    sensitivity,
    wind,
)
from tests.support.vortex_pairs import uneven, vector

DT = 0.1


def grid(columns=41, rows=31, spacing=1.0):
    y, z = ((np.arange(n) - (n - 1) / 2) * spacing for n in (columns, rows))
    return [torch.as_tensor(a) for a in np.meshgrid(y, z)]


@pytest.mark.parametrize("profile", PROFILES)
def test_wind_is_the_vortices_own(profile):
    """Against the closed forms of `atmosphere.vortices.vortex`, written apart from these."""
    pair = uneven(profile)
    y, z = grid()
    ours = wind(torch.as_tensor(vector(*pair, mean=(1.5, -0.5))), y, z, profile)
    v, w = velocity(pair, y.numpy(), z.numpy())
    np.testing.assert_allclose(ours[0], v + 1.5, atol=1e-12)
    np.testing.assert_allclose(ours[1], w - 0.5, atol=1e-12)


@pytest.mark.parametrize("profile", PROFILES)
def test_derivatives_by_differences(profile):
    theta = torch.as_tensor(vector(*uneven(profile), mean=(1.0, 2.0)))
    y, z = grid()
    step = 1e-5
    along_y, along_z = (
        (
            wind(theta, y + a * step, z + b * step, profile)
            - wind(theta, y - a * step, z - b * step, profile)
        )
        / (2 * step)
        for a, b in ((1, 0), (0, 1))
    )
    v_y, v_z, w_y = gradient(rotations(theta, y, z, profile))
    for ours, expected in ((v_y, along_y[0]), (v_z, along_z[0]), (w_y, along_y[1])):
        np.testing.assert_allclose(ours, expected, atol=1e-6)
    np.testing.assert_allclose(along_z[1], -v_y, atol=1e-6)
    along = torch.as_tensor(np.random.default_rng(1).standard_normal((2, *y.shape)))
    columns = sensitivity(rotations(theta, y, z, profile), along)
    for index, name in enumerate(PARAMETERS):
        push = step * torch.eye(10, dtype=theta.dtype)[index]
        change = wind(theta + push, y, z, profile) - wind(theta - push, y, z, profile)
        expected = (along * change).sum(0) / (2 * step)
        np.testing.assert_allclose(columns[index], expected, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("core", [3.0, 0.5])
def test_paths_turn_with_the_vortex(core):
    """Alone, a vortex turns air at the radius r by v_t(r) t / r: closed form, to 1 mm.

    In 0.05 s the core of 0.5 m turns 2.5 times.
    """
    alone = torch.as_tensor(vector(Vortex(400.0, core, 0.0, 0.0), Vortex(-1e-9, 3.0, 500.0, 0.0)))
    radius = torch.linspace(0.1, 20.0, 60, dtype=torch.float64)
    _, place = advected(alone, radius, torch.zeros_like(radius), DT / 2, "lamb_oseen")
    swirl = 400 / (2 * np.pi * radius) * (1 - torch.exp(-1.2564 * radius**2 / core**2))
    angle = swirl * DT / 2 / radius
    expected = radius * torch.stack([torch.cos(angle), torch.sin(angle)])
    np.testing.assert_allclose(place, expected, atol=1e-3)


@pytest.mark.parametrize("time", [0.05, -0.05])
def test_path_sensitivity_by_differences(time):
    """To the 0.7 % that the path's middle stands for the whole."""
    pair = Vortex(400.0, 3.0, 23.5, 0.0), Vortex(-380.0, 3.5, -23.0, 1.0)
    theta = torch.as_tensor(vector(*pair, mean=(1.0, 0.5)))
    y, z = grid(110, 60)
    along = torch.as_tensor(np.random.default_rng(2).standard_normal((2, *y.shape)))
    middle, _ = advected(theta, y, z, time, "lamb_oseen")
    columns = path_sensitivity(theta, middle, along, time, "lamb_oseen")
    for index in range(10):
        push = 1e-4 * torch.eye(10, dtype=theta.dtype)[index]
        ends = [advected(theta + s * push, y, z, time, "lamb_oseen")[1] for s in (1, -1)]
        expected = (along * (ends[0] - ends[1])).sum(0) / 2e-4
        assert (columns[index] - expected).norm() < 0.012 * expected.norm(), PARAMETERS[index]


def test_pair_drifts_down_by_its_own_swirl():
    pair = vortex_pair(400.0, 47.1, 3.0)
    moving = drift(torch.as_tensor(vector(*pair, mean=(2.0, 1.0))), "lamb_oseen")
    np.testing.assert_allclose(moving, [2.0, 1.0 - 400 / (2 * np.pi * 47.1)], atol=1e-9)


def test_slow_air_takes_one_step_and_as_exact_a_path():
    """Against paths of 64 steps, of single times and of one for each place."""
    theta = torch.as_tensor(vector(*uneven(), mean=(3.0, -1.0)))
    y, z = grid(61, 41)
    for time in (-0.05, 0.05):
        start = torch.stack([y, z])
        exact, _ = _followed(theta, start, wind(theta, y, z, "lamb_oseen"), time, 64, "lamb_oseen")
        middle, place = advected(theta, y, z, time, "lamb_oseen")
        half, _ = _followed(
            theta, start, wind(theta, y, z, "lamb_oseen"), time / 2, 64, "lamb_oseen"
        )
        # m: 1e-3 px of half a metre; middles are for derivatives only
        assert float((place - exact).abs().max()) < 5e-4
        assert float((middle - half).abs().max()) < 0.02
        each = advected(theta, y[None], z[None], torch.tensor([[[time]], [[-time]]]), "lamb_oseen")
        for alone, both in zip((middle, place), each, strict=True):
            torch.testing.assert_close(both[:, 0], alone)
