"""Whether a coloured misfit is whitened: detects filters that cost more accuracy than they gain."""

import pytest
import torch

from lidar_mi.retrieval.images.band_limit import PowerSpectrum, flat_if_better, radii, wavenumbers

SHAPE, SIZES = (60, 60), (75, 75)
SLOPES = (0.0, 0.2, 0.35, 0.7, 1.5)


def spectrum(slope):
    """Of texture of white slopes, and a mismatch that falls with the wavenumber to this power."""
    shells = int(radii(SIZES, SHAPE, torch.float64, torch.device("cpu"))[1].max()) + 1
    wave = wavenumbers(torch.zeros(shells, dtype=torch.float64), SHAPE)
    mismatch = 1e-3 * wave**-slope
    return PowerSpectrum(10 * wave**-2, 0.01 * torch.ones_like(wave), SHAPE, SIZES), mismatch


def gain_of_whitening(slope, strain):
    """Variance of a displacement without whitening over that with it, wave by wave.

    A filter whose square is k^slope as it whitens makes a wave of strained air differ by
    strain * slope / 2 of its amplitude.
    """
    power, mismatch = spectrum(slope)
    shell = radii(SIZES, SHAPE, torch.float64, torch.device("cpu"))[1].flatten()
    shell = shell[(power.density > 1.02 * mismatch)[shell]]
    wave, noise = wavenumbers(power.density, SHAPE)[shell], mismatch[shell]
    texture = power.density[shell] - noise
    passed = texture / (texture + noise / 2)
    deformed = strain * (slope / 2) ** 2 * texture
    flat, white = (
        float((wave**2 * texture * g**2 * n).sum() / (wave**2 * texture * g).sum() ** 2)
        for g, n in ((passed, noise), (passed / noise, noise + deformed))
    )
    return flat / white


@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("strain", [0.0, 1e-4, 1e-2])
def test_only_a_colour_that_lessens_the_variance_is_whitened(slope, strain):
    power, mismatch = spectrum(slope)
    found = flat_if_better(power, mismatch, 2.0, strain)
    if gain_of_whitening(slope, strain) > 1 + 1e-9:
        assert torch.equal(found, mismatch)
    else:
        assert (found == found[0]).all()
        assert mismatch.min() * (1 - 1e-9) <= found[0] <= mismatch.max() * (1 + 1e-9)


def test_whitening_lessens_errors_in_air_at_rest_and_not_in_strained_air():
    still, strained = ([gain_of_whitening(a, e) for a in SLOPES] for e in (0.0, 1e-2))
    assert still == sorted(still) and still[-1] > 1.1
    assert max(strained[1:]) < 1


def test_images_without_texture_keep_their_mismatch():
    power, mismatch = spectrum(0.1)
    assert torch.equal(flat_if_better(power, 1e9 * mismatch, 2.0, 0.0), 1e9 * mismatch)
