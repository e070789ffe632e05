"""The prior of a flow against cases solved by hand, integrals and random flows of known spectra.

Detects steps that end far from the largest evidence, a spectral slope or a ratio of divergence that
is not that of the flow, a strength that grows for ever.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow import direct
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import _gamma_mean, first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from tests.support.random_flows import random_flow

SETTINGS = VariationalSettings()
AXES = [Axis(64, 4.0), Axis(64, 4.0)]


def after(rounds, squares, noise, start):
    """Strength where each motion is seen by itself with white noise; its mean square is given.

    One strength for the whole mesh: posterior variance 1 / (L + 1 / noise), mean y / (1 + noise L).
    """
    flow = torch.zeros(2, *(axis.knots for axis in AXES), dtype=torch.float64)
    prior = first_prior(AXES, flow, 1e3, (1.0, 1.0), SETTINGS)
    prior = prior._replace(local=torch.full_like(prior.local, start / prior.cell))
    for _ in range(rounds):
        strength = prior.cell * prior.local
        posterior = 1 / (strength + 1 / noise)
        energy = squares / (1 + noise * strength) ** 2
        prior = prior.updated(1 / strength - posterior, energy, SETTINGS)
    return (prior.cell * prior.local).log().mean((1, 2)).exp().numpy()


@pytest.mark.parametrize("start", [0.1, 30.0])
@pytest.mark.parametrize(("noise", "pulled"), [(0.01, 0.01), (1.0, 0.05), (4.0, 0.35)])
def test_steps_end_at_the_largest_likelihood(noise, pulled, start):
    """y has the variance 1 / L + noise, so that 1 / L is its mean square less the noise.

    Ten motions of a divergence of ratio 5 pull that of 900 motions as far as their own likelihood
    is flat: its scatter would be 0.25 of those that images inform by a fifth.
    """
    vorticity, divergence, *gradients = np.log(after(40, 1.0 + noise, noise, start))
    assert abs(vorticity) < 1e-3 and 0 <= divergence < pulled
    assert gradients == pytest.approx([vorticity, divergence], abs=1e-3)


def test_motions_that_are_zero_end_at_a_strong_prior():
    strength = after(60, 0.0, 1.0, 1.0)
    assert np.isfinite(strength).all() and strength.min() > 1e4


@pytest.mark.parametrize("shape", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("motions", [6.0, 30.0])
def test_expected_strengths_are_those_of_the_integrated_posterior(shape, motions):
    """Strengths of a known gamma distribution, each seen through the squares of some motions.

    Integrals use that distribution. The estimate has it from 4000 places, its shape from a grid of
    factors of 2: expected strengths differ by 10 % on average.
    """
    random = np.random.default_rng(1)
    strength = random.gamma(shape, 1 / 3.0, 4000)
    squares = random.chisquare(motions, 4000) / strength
    found = _gamma_mean(torch.full((4000,), motions).double(), torch.as_tensor(squares)).numpy()

    grid = np.exp(np.linspace(-30.0, 5.0, 4001))

    def expected(square):
        # per logarithm of the strength
        log = (shape + motions / 2) * np.log(grid) - grid * (3.0 + square / 2)
        density = np.exp(log - log.max())
        return (grid * density).sum() / density.sum()

    places = np.argsort(squares)[::200]
    ratio = found[places] / [expected(square) for square in squares[places]]
    assert np.abs(np.log(ratio)).mean() < 0.1
    # a mean of conditional expectations is the mean itself
    assert found.mean() == pytest.approx(strength.mean(), rel=0.1)


def test_vorticity_and_divergence_in_a_plane_of_isotropic_turbulence():
    """Of 400 000 waves in three dimensions, transverse to random directions."""
    random = np.random.default_rng(2)
    way, along = random.standard_normal((2, 400_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    velocity = np.cross(way, along)
    vorticity = np.cross(way, velocity)[:, 0]
    divergence = -way[:, 0] * velocity[:, 0]
    ratio = np.mean(vorticity**2) / np.mean(divergence**2)
    assert SETTINGS.ratio == pytest.approx(ratio, rel=0.02)


def observed(flow, noise, seed):
    """White noise added to one component of a flow (2, z, y), px, at each pixel in turn."""
    shape = flow.shape[1:]
    odd = (torch.arange(shape[0])[:, None] + torch.arange(shape[1])) % 2
    slope = torch.stack([1.0 - odd, odd]).double()
    random = np.random.default_rng(seed)
    seen = (slope * flow).sum(0) + noise * torch.as_tensor(random.standard_normal(shape))
    weight = torch.full(shape, noise**-2).double()
    images = torch.zeros(2, *shape).double()
    gradient = weight * seen * slope
    return Linear(
        slope, gradient, weight, noise**2, images, images, weight > 0, torch.ones_like(weight)
    )


@pytest.mark.slow
@pytest.mark.parametrize("turnover", [0.1, 0.4])
def test_the_spectrum_of_a_random_flow_is_found(turnover):
    """Density of displacements in waves of 10 to 60 px, whatever its slope.

    Vorticity ~ 1 / (1 + (k / turnover)^2) in four seeds, to 20 % and three standard errors of as
    many waves as are in an octave.
    """
    size, seeds = 160, range(1, 5)
    waves = 2 * np.pi / np.array([10.0, 15.0, 25.0, 40.0, 60.0])
    found = []
    for seed in seeds:
        flow, density = random_flow((size, size), 0.5, turnover, SETTINGS.ratio, seed)
        axes = [Axis(size, 4.0)] * 2
        mesh = Mesh(axes, [torch.arange(size).double()] * 2)
        linear = observed(flow, 0.2, seed)
        still = torch.zeros(2, *(axis.knots for axis in axes)).double()
        start = replace(SETTINGS, least_vorticity=0.05)
        prior = first_prior(axes, still, 5.2, (1.0, 1.0), start)
        for iteration in range(8):
            # the observations are those of the flow itself, so that every step starts from rest
            posterior = direct.solved(linear, mesh, still, prior, SETTINGS, iteration)
            prior = prior.updated(*posterior.evidence(), SETTINGS)
        found.append([float(prior.density(k).mean()) / density(k) for k in waves])
    # of the lattice of waves 2 pi / size apart, from k / sqrt(2) to k sqrt(2)
    number = 1.5 * np.pi * (waves * size / (2 * np.pi)) ** 2
    limit = np.log(1.2) + 3 * np.sqrt(2 / (number * len(seeds)))
    assert (np.abs(np.log(np.mean(found, 0))) < limit).all()
