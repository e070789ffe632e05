"""Flags: texture of images with known gradients, uncertainty in the worst direction.

Detects a factor in the gradient matrix, a wrong threshold, a direction that is forgotten.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.quality import (
    clearly_textured,
    low_texture,
    non_finite,
    texture,
    uncertain,
    usable,
)
from lidar_mi.retrieval.images.windows import Windows

WINDOWS = Windows((48, 64), 8, 16, 1)


def crossed(a, b, mean=1.0, tilt=0.0):
    """Waves of 8 px across and along, so that a template holds whole periods."""
    y, z = np.meshgrid(np.arange(64.0), np.arange(48.0))
    k = 2 * np.pi / 8
    return torch.as_tensor(mean * (1 + a * np.cos(k * y + tilt) + b * np.cos(k * z)))


@pytest.mark.parametrize("a, b", [(0.2, 0.1), (0.1, 0.2), (0.1, 0.1), (0.2, 0.0)])
@pytest.mark.parametrize("mean", [1.0, 1e-9])
def test_texture_of_crossed_waves(a, b, mean):
    """A central difference of cos(k y) has amplitude sin(k), so the rms slope is a sin(k)/sqrt2."""
    found = texture(crossed(a, b, mean), WINDOWS)
    slope = min(a, b) * np.sin(2 * np.pi / 8) / np.sqrt(2)
    np.testing.assert_allclose(found.slope, slope, atol=1e-7)
    np.testing.assert_allclose(found.isotropy, min(a, b) / max(a, b), atol=1e-6)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)


def test_diagonal_stripes_have_no_texture():
    y, z = np.meshgrid(np.arange(64.0), np.arange(48.0))
    found = texture(torch.as_tensor(1 + 0.3 * np.cos(0.6 * (y + z))), WINDOWS)
    assert found.slope.max() < 1e-6 and found.isotropy.max() < 1e-5


@pytest.mark.parametrize(
    ("isotropy", "clear"), [(0.0, True), (0.3, True), (0.4, False), (0.6, False), (1.0, False)]
)
def test_clear_texture_passes_thresholds_half_as_high_again(isotropy, clear):
    """Isotropy 0.5 is 1.5 times 0.33; of thresholds above 1/2 it is half way to 1."""
    found = texture(crossed(0.2, 0.1), WINDOWS)
    slope = float(found.slope.min())
    assert bool((clearly_textured(found, slope / 1.6, isotropy) == clear).all())
    assert not bool(clearly_textured(found, slope / 1.4, isotropy).any())
    even = texture(crossed(0.1, 0.1), WINDOWS)._replace(isotropy=torch.tensor([0.79, 0.81]))
    assert clearly_textured(even._replace(slope=torch.ones(2)), 0.0, 0.6).tolist() == [False, True]


def test_noise_passes_three_sixteenths():
    """Mean squared slopes of white noise: both eigenvalues together 2 x 3/16 of its variance."""
    rng = np.random.default_rng(1)
    image = torch.as_tensor(1 + 0.01 * rng.standard_normal((400, 400)))
    found = texture(image, Windows((400, 400), 8, 16, 8))
    weakest = (found.slope * found.mean) ** 2
    total = weakest * (1 + 1 / found.isotropy**2)
    # 2304 windows of about 20 independent values each: 0.5 % standard error
    assert float(total.mean()) / 1e-4 == pytest.approx(2 * 3 / 16, rel=0.02)


def test_low_texture_by_each_reason():
    image = crossed(0.2, 0.02)
    weak = 0.02 * np.sin(2 * np.pi / 8) / np.sqrt(2)
    for expected, options in (
        (False, {"min_texture": 0.99 * weak}),
        (True, {"min_texture": 1.01 * weak}),
        (False, {"min_texture": 0, "min_isotropy": 0.099}),
        (True, {"min_texture": 0, "min_isotropy": 0.101}),
        (False, {"min_texture": 0, "noise": 0.99 * weak / np.sqrt(3 / 8)}),
        (True, {"min_texture": 0, "noise": 1.01 * weak / np.sqrt(3 / 8)}),
        (True, {"min_texture": 0, "noise": torch.full((48, 64), 1.01 * weak / np.sqrt(3 / 8))}),
    ):
        _, low = low_texture(image, WINDOWS, **options)
        assert (low == expected).all(), options


def test_constant_image_is_low_even_at_threshold_zero():
    for value in (0.0, 0.3):
        found, low = low_texture(torch.full((48, 64), value), WINDOWS, 0.0)
        assert low.all() and (found.slope == 0).all()


def test_noise_only_is_mostly_flagged():
    rng = np.random.default_rng(2)
    image = torch.as_tensor(1 + 0.05 * rng.standard_normal((48, 64)))
    _, low = low_texture(image, WINDOWS, 0.0, noise=0.05)
    assert low.double().mean() > 0.99


def test_non_finite_in_either_image():
    first, second = torch.ones(48, 64), torch.ones(48, 64)
    first[0, 0], second[47, 63] = torch.nan, -torch.inf
    bad = non_finite([first, second], WINDOWS)
    assert bad.sum() == 2 and bad[0, 0] and bad[-1, -1]


def test_uncertain_is_the_worst_direction():
    """Variances of 0.2 px^2 with a correlation of 0.5: 0.3 along the diagonal, beyond 1/4."""
    covariance = torch.tensor([[0.2, 0.1], [0.1, 0.2]])[:, :, None]
    assert bool(uncertain(covariance)) and not bool(uncertain(0.8 * covariance))
    volume = torch.diag(torch.tensor([0.1, 0.1, 0.3]))[:, :, None]
    assert bool(uncertain(volume)) and not bool(uncertain(0.8 * volume))
    assert bool(uncertain(torch.full((2, 2, 1), torch.nan)))


@pytest.mark.parametrize("shape", [(11, 12), (11, 12, 13)])
def test_usable_pixels_are_three_away_from_a_hole(shape):
    image = torch.ones(shape)
    image[(5,) * len(shape)] = torch.inf
    found = usable([image, torch.ones(shape)])
    assert int((~found[0]).sum()) == 7 ** len(shape) and bool(found[1].all())
    assert not bool(found[0][(slice(2, 9),) * len(shape)].any())


def test_volumes_lose_the_windows_whose_template_holds_a_hole():
    volume = torch.ones(10, 12, 14)
    volume[5, 6, 7] = torch.nan
    windows = Windows((10, 12, 14), 4, 8, 1)
    bad = non_finite([torch.ones(10, 12, 14), volume], windows)
    assert bad.shape == windows.count and int(bad.sum()) == 4**3
    assert bool(bad[2:6, 3:7, 4:8].all())


def test_a_bit_per_reason():
    values = [bit.value for bit in Flag]
    assert values == [2**k for k in range(len(values))] and values[-1] < 2**15


def test_bad_input_is_named():
    image = torch.ones(48, 64)
    for call, start in (
        (lambda: low_texture(image, WINDOWS, -1.0), "min_texture: -1.0"),
        (lambda: low_texture(image, WINDOWS, 0.0, 1.5), "min_isotropy: 1.5"),
        (lambda: low_texture(image, WINDOWS, 0.0, noise=-1.0), "noise:"),
        (lambda: low_texture(image, WINDOWS, 0.0, noise=torch.ones(3, 3)), "noise: shape (3, 3)"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value).startswith(start) and "\n" not in str(error.value)
