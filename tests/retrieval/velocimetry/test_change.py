"""Air that changes: the displacement across the plane is recovered, and winds without skill named.

Detects a displacement that is wrong by a quarter, change found in air that has none, standard
errors too small by a third where texture is replaced, and smooth air that changes called valid.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.velocimetry.band_limit import wavenumbers
from lidar_mi.retrieval.velocimetry.change import displaced, unexplained
from lidar_mi.retrieval.velocimetry.quality import no_skill
from lidar_mi.retrieval.velocimetry.warping import band_limited, mismatch
from validation.coverage import measured

NOISE = 1e-3


def slices(through, seed):
    """Two slices, displaced by `through` px, of an isotropic volume of spectral density K^-5.

    The waves of one wavenumber k in a slice then have the mean square wavenumber k^2 / 2 across it.
    """
    random = np.random.default_rng(seed)
    across = np.arange(-64, 64)[:, None, None] * 0.2
    z, y = 2 * np.pi * np.fft.fftfreq(128)[:, None], 2 * np.pi * np.fft.rfftfreq(160)
    square = across**2 + z**2 + y**2
    root = np.where(z**2 + y**2 > 0, np.maximum(square, 1e-3) ** -1.25, 0.0)
    wave = root * (random.standard_normal(root.shape) + 1j * random.standard_normal(root.shape))
    pair = [np.fft.irfft2((wave * np.exp(1j * across * d)).sum(0)) for d in (0.0, through)]
    pair = [image / pair[0].std() + NOISE * random.standard_normal(image.shape) for image in pair]
    return torch.tensor(np.stack(pair))


def found(stack):
    spline, noise = band_limited(stack, NOISE)
    places = torch.meshgrid(*(torch.arange(n).to(stack) for n in stack.shape[1:]), indexing="ij")
    value = spline.sample(*(torch.stack([place, place]) for place in places))[0]
    density = mismatch(spline, value - value.mean(0))
    return unexplained(spline, density, displaced(spline, stack, noise), 4.0) ** 0.5


@pytest.mark.parametrize("through", [0.1, 0.3])
def test_displacement_across_the_plane_is_recovered(through):
    """The mean of two pairs; one is right to 10 %, and tapering mixes neighbouring shells."""
    assert np.mean([found(slices(through, seed)) for seed in range(2)]) == pytest.approx(
        through, rel=0.15
    )


def test_gradient_across_a_slice_of_gaussian_structure():
    """T = exp(-(k^2 + q^2) / 2 s^2): that gradient's density is s^2 S(k), so half of it s^2 S / 2.

    In long waves it is far above k^2 S / 4, which the gradients in the plane would suggest. Noise
    is so low that all of the spectrum counts.
    """
    random = np.random.default_rng(3)
    s = 0.4
    z, y = 2 * np.pi * np.fft.fftfreq(256)[:, None], 2 * np.pi * np.fft.rfftfreq(320)
    wave = np.exp(-(z**2 + y**2) / (4 * s**2))
    images = [
        np.fft.irfft2(wave * np.fft.rfft2(random.standard_normal((256, 320)))) for _ in range(4)
    ]
    stack = torch.tensor(np.stack(images))
    spline, _ = band_limited(stack, 1e-9)
    k = wavenumbers(spline.gain, spline.shape).numpy()
    expected = s**2 / 2 * np.exp(-(k**2) / (2 * s**2))
    ratio = displaced(spline, stack, 1e-9).numpy() / expected
    # a cumulative sum over many waves; tapering blurs a shell into its neighbours
    assert ratio[(k > 0.05) & (k < 2 * s)] == pytest.approx(1, abs=0.1)


def test_noise_is_no_change():
    assert found(slices(0.0, 2)) == 0.0


def test_vectors_without_skill():
    """One of uncertain vectors, all where they are uncertain on average, none in uniform wind."""
    d = torch.zeros(2, 1, 9)
    d[0] = torch.linspace(-1, 1, 9)  # its variance is 5/12, the mean of both components 5/24
    variance = torch.full((1, 9), 0.01)
    variance[0, 3] = 0.06

    def flagged(d):
        return no_skill(d, torch.eye(2)[:, :, None, None] * variance).flatten().tolist()

    assert flagged(d) == [n == 3 for n in range(9)]
    assert all(flagged(0.1 * d))
    variance = torch.full((1, 9), 0.04**2)
    assert not any(flagged(0 * d))


@pytest.mark.slow
@pytest.mark.parametrize("case", ["5 % of the texture replaced", "30 % of the texture replaced"])
def test_standard_errors_where_texture_is_replaced(case):
    """Of another seed than the model was chosen with."""
    row = measured(case, "variational", [2])
    assert row.rmse < {"5": 0.21, "3": 0.7}[case[0]]
    assert 0.7 < row.variance[0] < 1.4


@pytest.mark.slow
def test_smooth_air_that_changes_gives_no_valid_vector():
    assert measured("true second state, texture 0 %", "variational", [1]).valid < 0.05
