"""Whether a coloured misfit is whitened: detects filters that cost more accuracy than they gain."""

import pytest
import torch

from lidar_mi.retrieval.images.band_limit import PowerSpectrum, flat_if_nearly, radii, wavenumbers

SHAPE, SIZES = (60, 60), (75, 75)


def spectrum(slope):
    """Of texture of white slopes, and a mismatch that falls with the wavenumber to this power."""
    shells = int(radii(SIZES, SHAPE, torch.float64, torch.device("cpu"))[1].max()) + 1
    wave = wavenumbers(torch.zeros(shells, dtype=torch.float64), SHAPE)
    mismatch = 1e-3 * wave**-slope
    mismatch[-5:] = torch.inf
    return PowerSpectrum(10 * wave**-2, 0.01 * torch.ones_like(wave), SHAPE, SIZES), mismatch


def loss(power, mismatch):
    """Excess variance of a displacement without whitening, wave by wave of the transform."""
    shell = radii(SIZES, SHAPE, torch.float64, torch.device("cpu"))[1].flatten()
    use = torch.isfinite(mismatch) & (power.density > 1.02 * mismatch)
    shell = shell[use[shell]]
    wave, noise = wavenumbers(power.density, SHAPE)[shell], mismatch[shell]
    texture = power.density[shell] - noise
    passed = texture / (texture + noise / 2)
    flat, white = (
        float((wave**2 * texture * g**2 * noise).sum() / (wave**2 * texture * g).sum() ** 2)
        for g in (passed, passed / noise)
    )
    return flat / white - 1


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.35, 0.7, 1.5])
def test_only_a_colour_that_costs_10_percent_of_the_variance_is_whitened(slope):
    power, mismatch = spectrum(slope)
    found = flat_if_nearly(power, mismatch, 2.0)
    assert torch.equal(found.isinf(), mismatch.isinf())
    known = found[found.isfinite()]
    if loss(power, mismatch) > 0.1:
        assert torch.equal(found, mismatch)
    else:
        assert (known == known[0]).all()
        given = mismatch[mismatch.isfinite()]
        assert given.min() * (1 - 1e-9) <= known[0] <= given.max() * (1 + 1e-9)


def test_both_sides_of_the_limit_are_tried():
    losses = [loss(*spectrum(slope)) for slope in (0.0, 0.2, 0.35, 0.7, 1.5)]
    assert losses == sorted(losses) and losses[1] < 0.1 < losses[3]


def test_images_without_texture_keep_their_mismatch():
    power, mismatch = spectrum(0.1)
    assert torch.equal(flat_if_nearly(power, 1e9 * mismatch, 2.0), 1e9 * mismatch)
