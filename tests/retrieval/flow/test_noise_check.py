"""Noise that is not white: detects errors that are stated for white noise of its spectrum's floor.

Frames that were denoised, demosaiced or resampled have noise that is correlated over pixels.
"""

import numpy as np
import pytest
import torch
from scipy import ndimage

from lidar_mi.retrieval.flow.noise_check import _density
from lidar_mi.retrieval.flow.variational import variational

SHAPE = 96, 112
SHIFT = -0.6, 1.4


def pair(seed, noise):
    """Gaussian texture of 2 px and 30 %, moved exactly (by Fourier), and noise of a function."""
    k = np.fft.fftfreq(192)
    wave = np.fft.fft2(np.random.default_rng(seed).standard_normal((192, 192)))
    wave = wave * np.exp(-2 * np.pi**2 * 4 * (k[:, None] ** 2 + k**2))
    phase = np.exp(-2j * np.pi * (k[:, None] * SHIFT[0] + k * SHIFT[1]))
    first, second = (np.fft.ifft2(part).real for part in (wave, wave * phase))
    cut = slice(40, 40 + SHAPE[0]), slice(40, 40 + SHAPE[1])
    random = np.random.default_rng([seed, 1])
    return [
        torch.as_tensor(1 + 0.3 * part[cut] / first.std() + noise(random))
        for part in (first, second)
    ]


def correlated(amplitude, size):
    def noise(random):
        field = ndimage.gaussian_filter(random.standard_normal(SHAPE), size)
        return amplitude * field / field.std()

    return noise


def errors(images):
    """Normalised errors and standard errors of vectors that are known to half a pixel."""
    found = variational(*images, 8, 16, 4)
    true = torch.tensor(SHIFT, dtype=torch.float64)[:, None, None]
    stated = found.covariance.diagonal().movedim(-1, 0).sqrt()
    valid = (found.flag == 0) & (stated.amax(0) < 0.5)
    return ((found.d - true) / stated)[:, valid].numpy(), stated[:, valid].numpy()


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "size"), [(0.01, 2.0), (0.03, 2.0), (0.03, 3.0)])
def test_errors_of_correlated_noise_are_stated_or_flagged(amplitude, size):
    normalised, _ = errors(pair(3, correlated(amplitude, size)))
    if normalised.size:
        assert np.mean(np.abs(normalised) > 4) < 0.01
        assert 0.2 < np.mean(normalised**2) < 4.0


def test_white_noise_keeps_its_errors():
    """Those of the Cramer-Rao bound of the whole image at least, and at most ten times these."""
    _, stated = errors(pair(4, lambda random: 0.01 * random.standard_normal(SHAPE)))
    # squared slopes of a Gaussian texture: variance / (2 size^2)
    bound = 0.01 * 2**0.5 / (0.3 / (2 * 2**0.5) * (SHAPE[0] * SHAPE[1]) ** 0.5)
    assert bound < np.median(stated) < 10 * bound


def test_density_is_that_of_the_noise():
    """White, and with an offset of each column, which half of the pixels show."""
    random = np.random.default_rng(5)
    white = torch.as_tensor(random.standard_normal(SHAPE))
    use = torch.as_tensor(random.uniform(size=SHAPE) < 0.5).double()
    density, lines = _density(white, use)
    assert not lines
    assert float(density.mean()) == pytest.approx(1.0, abs=0.1)
    columns = white + 2 * torch.as_tensor(random.standard_normal((1, SHAPE[1])))
    density, lines = _density(columns, use)
    assert lines == "columns"
    along = density[0, 10:100].mean() / density[20:90, 10:100].mean()
    # all of the offsets' variance is in the waves across the columns
    assert float(along) > 20
