"""The Cramer-Rao bound of displacement against its closed form and known numbers.

Detects 5 % of error in the bound, an axis or sign taken for the other, noise counted as texture,
and windows in the wrong place.
"""

import numpy as np
import pytest
import torch

from benchmarks.cases import DT, SPACING, vortex_pair_images
from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.bound import displacement_bound


def tensors(pair):
    return [torch.tensor(image.values) for image in (pair.first, pair.second)]


def wave(a, b, rows=60, columns=80):
    z, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    return torch.tensor(1 + 0.1 * np.cos(a * y + b * z + 0.3))


def test_two_waves_have_the_closed_form():
    """Slopes (a, b), (a, -b) of amplitude 0.1: mean squares 0.01 a^2 and 0.01 b^2, no product."""
    a, b, noise, n = 2 * np.pi / 8, 2 * np.pi / 12, 0.01, 24
    image = wave(a, b) + wave(a, -b)
    zz, yy, zy = displacement_bound(image, image, noise, n)
    expected = 2 * noise**2 / (n**2 * 0.01)
    assert zz.shape == (37, 57)
    inner = slice(8, -8)
    np.testing.assert_allclose(zz[inner, inner], expected / b**2, rtol=0.03)
    np.testing.assert_allclose(yy[inner, inner], expected / a**2, rtol=0.03)
    assert zy[inner, inner].abs().max() < 0.02 * expected / (a * b)


def test_stripes_leave_their_own_direction_open():
    """Nearly parallel waves along (1, 1): the error lies along (1, -1), where nothing changes."""
    image = wave(0.6, 0.6) + wave(0.55, 0.65)
    zz, yy, zy = displacement_bound(image, image, 0.01, 16)
    correlation = (zy / (zz * yy).sqrt())[8:-8, 8:-8]
    assert correlation.median() < -0.9 and correlation.max() < -0.6
    one = wave(0.6, 0.6)
    zz, yy, zy = displacement_bound(one, one, 1e-6, 16)
    # but for the image's edge, nothing at all is known along the stripes; across them a window of
    # 16 px tells sqrt(2) noise / (rms slope sqrt(256)), 20 % of the noise
    assert (zz[15:-15, 15:-15].sqrt() > 30e-6).all()


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.06])
def test_known_numbers_of_the_vortex_pair(noise):
    """Rms over the windows of 8, 12 and 16 px of the known case: v in m/s per noise of 1 %."""
    first, second = tensors(vortex_pair_images(noise))
    for window, known in ((8, 12.0), (12, 7.2), (16, 5.2)):
        yy = displacement_bound(first, second, noise, window)[1]
        assert yy.mean().sqrt() * SPACING / DT == pytest.approx(known * noise, rel=0.12)


def test_noise_is_estimated_and_not_taken_for_texture():
    """The bound with the noise left out, against the one from clean slopes and the true noise."""
    noise = 0.06
    clean = tensors(vortex_pair_images(0.0, 2))[0]
    first, second = tensors(vortex_pair_images(noise, 2))
    found = displacement_bound(first, second, window=16)[1]
    true = displacement_bound(clean, clean, noise, 16)[1]
    assert (found.log().mean() - true.log().mean()).exp() == pytest.approx(1, abs=0.1)


def test_noise_of_each_pixel():
    first, second = tensors(vortex_pair_images(0.0, columns=80, rows=60))
    level = torch.full_like(first, 0.02)
    level[:, 40:] = 0.04
    both = displacement_bound(first, second, level, 8)[1].sqrt()
    one = displacement_bound(first, second, 0.02, 8)[1].sqrt()
    ratio = both / one
    assert ratio[:, :30].median() == pytest.approx(1, rel=0.05)
    assert ratio[:, 42:].median() == pytest.approx(2, rel=0.05)


def test_no_texture_no_bound():
    flat = torch.full((30, 40), 2.0)
    zz, yy, zy = displacement_bound(flat, flat, 0.1)
    assert torch.isinf(zz).all() and torch.isinf(yy).all() and (zy == 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window": 50}, "window: 50 px does not fit"),
        ({"window": 1}, "template: 1 px"),
        ({"noise": -0.1}, "noise: -0.1 is not"),
        ({"noise": torch.zeros(30, 40)}, "noise: not a standard deviation > 0"),
        ({"image2": torch.full((30, 40), torch.nan)}, "non-finite"),
        ({"image2": torch.ones(30, 41)}, "differ"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(InputError, match=message):
        displacement_bound(**{"image1": wave(1, 1, 30, 40), "image2": wave(1, 1, 30, 40)} | change)
