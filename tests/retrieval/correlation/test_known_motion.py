"""Images of air that moves as vectors say.

Detects vectors that bend a shear at the rim, windows of a wrong width, and air moved to a wrong
place.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.correlation.known_motion import advected, of_windows, on_pixels, origin
from lidar_mi.retrieval.images.spline import band_limited
from lidar_mi.retrieval.images.windows import Windows
from tests.support.flows import plane_waves, texture

SHAPE = (60, 80)
WINDOWS = Windows(SHAPE, 8, 16, 4)
Z, Y = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SHAPE), indexing="ij")


def test_vectors_of_a_shear_are_a_shear_up_to_the_edges():
    at = torch.meshgrid(*(WINDOWS.centres(axis) for axis in (0, 1)), indexing="ij")
    shear = torch.stack([0.1 * at[1] - 1, 0.05 * at[0]])
    expected = torch.stack([0.1 * Y - 1, 0.05 * Z])
    torch.testing.assert_close(on_pixels(shear, WINDOWS), expected)


@pytest.mark.parametrize(("centred", "sigma"), [(True, 8 / 3), (False, 8 / np.sqrt(12))])
def test_windows_attenuate_a_wave_as_gaussians_do(centred, sigma):
    k = 2 * np.pi / 16
    wave = torch.cos(k * Y)[None]
    found = of_windows(wave, WINDOWS, centred)[0, 20:40, 20:60]
    torch.testing.assert_close(
        found, np.exp(-((k * sigma) ** 2) / 2) * wave[0, 20:40, 20:60], atol=2e-3, rtol=0
    )


def test_air_turns_about_a_point():
    """By 0.2 rad per step, exactly: the texture is a function of position."""
    angle, middle = 0.2, (29.5, 39.5)
    off = torch.stack([Z - middle[0], Y - middle[1]])
    place = origin(angle * torch.stack([off[1], -off[0]]))
    cos, sin = np.cos(angle), np.sin(angle)
    exact = torch.stack([cos * off[0] - sin * off[1], sin * off[0] + cos * off[1]])
    exact += torch.tensor(middle)[:, None, None]
    inside = (off.norm(dim=0) < 25).expand(2, *SHAPE)
    assert float((place - exact)[inside].abs().max()) < 0.01
    waves = plane_waves(1, 4.0)
    spline, _ = band_limited([torch.as_tensor(texture(waves, Y, Z))], 0.0)
    moved = advected(spline, place)
    expected = torch.as_tensor(texture(waves, exact[1], exact[0]))
    assert float((moved.image - expected)[inside[0]].abs().max()) < 0.01
    assert bool(moved.inside[inside[0]].all()) and not bool(moved.inside[0, 0])
