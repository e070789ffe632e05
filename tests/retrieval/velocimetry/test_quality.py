"""Flags: texture of images with known gradients, the median test against its formula.

Detects a factor in the gradient matrix, a wrong median of an even number, a wrong threshold.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.velocimetry.quality import (
    Flag,
    low_texture,
    median_outliers,
    non_finite,
    texture,
)
from lidar_mi.retrieval.velocimetry.windows import Windows

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
    bad = non_finite(first, second, WINDOWS)
    assert bad.sum() == 2 and bad[0, 0] and bad[-1, -1]


def test_a_bit_per_reason():
    values = [bit.value for bit in Flag]
    assert values == [2**k for k in range(len(values))] and values[-1] < 256


def westerweel(dz, dy, reach, spacing, epsilon):
    """The normalised residual, one vector after the other."""
    rows, columns = dz.shape
    out = np.zeros((rows, columns))
    steps = [s * spacing for s in range(-reach, reach + 1)]
    for i in range(rows):
        for j in range(columns):
            for u in (dz, dy):
                around = [
                    u[i + a, j + b]
                    for a in steps
                    for b in steps
                    if (a, b) != (0, 0) and 0 <= i + a < rows and 0 <= j + b < columns
                ]
                if np.isfinite(around).sum() < 3:
                    continue  # too few to judge
                middle = np.nanmedian(around)
                spread = np.nanmedian(np.abs(np.array(around) - middle))
                out[i, j] += ((u[i, j] - middle) / (spread + epsilon)) ** 2
    return np.sqrt(out)


@pytest.mark.parametrize("size, spacing", [(3, 1), (5, 1), (3, 4)])
@pytest.mark.parametrize("room", [1, 2**27])
def test_median_test_is_the_published_formula(size, spacing, room, monkeypatch):
    monkeypatch.setattr("lidar_mi.retrieval.velocimetry.windows.TILE_BYTES", room)
    rng = np.random.default_rng(3)
    dz, dy = rng.standard_normal((2, 14, 17))
    dz[5, 6] = dy[5, 6] = np.nan
    residual = westerweel(dz, dy, size // 2, spacing, 0.1)
    found = median_outliers(torch.as_tensor(dz), torch.as_tensor(dy), size, spacing)
    assert 0.05 < found.double().mean() < 0.95
    np.testing.assert_array_equal(found, residual > 2)


def test_median_test_finds_the_one_wrong_vector():
    y, z = np.meshgrid(np.arange(20.0), np.arange(20.0))
    dz, dy = torch.as_tensor(0.1 * y), torch.as_tensor(-0.1 * z)  # solid rotation
    dy[8, 9] += 1.0
    found = median_outliers(dz, dy)
    assert found[8, 9]
    inner = found[1:-1, 1:-1]
    assert inner.sum() == 1


def test_lonely_vectors_are_not_judged():
    dz = torch.full((9, 9), torch.nan, dtype=torch.float64)
    dz[4, 4], dz[4, 5], dz[5, 4] = 0.0, 5.0, 5.0
    assert not median_outliers(dz, dz).any()


def test_bad_input_is_named():
    image, field = torch.ones(48, 64), torch.zeros(5, 5)
    for call, start in (
        (lambda: low_texture(image, WINDOWS, -1.0), "min_texture: -1.0"),
        (lambda: low_texture(image, WINDOWS, 0.0, 1.5), "min_isotropy: 1.5"),
        (lambda: low_texture(image, WINDOWS, 0.0, noise=-1.0), "noise:"),
        (lambda: low_texture(image, WINDOWS, 0.0, noise=torch.ones(3, 3)), "noise: shape (3, 3)"),
        (lambda: median_outliers(field, field, size=4), "median_size: 4"),
        (lambda: median_outliers(field, field, threshold=0), "median_threshold: 0"),
        (lambda: median_outliers(field, field, epsilon=float("nan")), "median_epsilon: nan"),
        (lambda: median_outliers(field, field, spacing=0), "spacing: 0"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value).startswith(start) and "\n" not in str(error.value)
