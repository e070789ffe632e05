"""Strength of the prior against the largest likelihood of a case solved by hand.

Detects steps that end far from the largest evidence, a strength that grows for ever, and standard
errors too small by a quarter where only the prior's distribution decides.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow.flow_spline import Axis
from lidar_mi.retrieval.flow.prior import first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from validation.coverage import measured

SETTINGS = VariationalSettings()
AXES = [Axis(64, 4.0), Axis(64, 4.0)]


def after(rounds, noise_known, squares, noise):
    """Strength where each rate is seen by itself with white noise; its mean square is given.

    One strength for the whole mesh: posterior variance 1 / (L + 1 / noise), mean y / (1 + noise L).
    """
    flow = torch.zeros(2, *(axis.knots for axis in AXES), dtype=torch.float64)
    prior = first_prior(AXES, flow, 1e3, (1.0, 1.0), SETTINGS)
    for _ in range(rounds):
        strength = prior.strength
        posterior = 1 / (strength + 1 / noise)
        energy = squares / (1 + noise * strength) ** 2
        prior = prior.updated(1 / strength - posterior, energy, SETTINGS, noise_known)
    return float(prior.local.log().mean().exp())


@pytest.mark.parametrize("noise", [0.01, 1.0, 4.0])
def test_steps_end_at_the_largest_likelihood(noise):
    """y has the variance 1 / L + noise, so that 1 / L is its mean square less the noise.

    Of rates of variance 1 with a fifth or more of the information from the images, to 10 %.
    """
    assert abs(np.log(after(9, True, 1.0 + noise, noise))) < 0.1
    assert abs(np.log(after(400, False, 1.0 + noise, noise))) < 0.1


def test_rates_that_are_zero_end_at_the_least_one():
    strength = after(60, True, 0.0, 1.0)
    assert np.isfinite(strength) and strength > 1e4


def test_a_prior_that_is_more_even():
    """Of one strength it is the same. A peak of variance keeps its sum and is as wide as stated.

    Gaussians of variances s^2 and (w / 2)^2 make one of their sum; by its second moment, to 3 %.
    """
    flow = torch.zeros(2, *(axis.knots for axis in AXES), dtype=torch.float64)
    prior = first_prior(AXES, flow, 6.0, (1.0, 1.0), SETTINGS)
    torch.testing.assert_close(prior.evened().local, prior.local)
    z, y = torch.meshgrid(*prior.mesh.places, indexing="ij")
    square = (z - z.mean()) ** 2 + (y - y.mean()) ** 2
    peak = 1e-9 + torch.exp(-square / (2 * 4.0**2))
    even = 1 / prior._replace(local=1 / peak[None]).evened().local[0]
    assert float(even.sum() / peak.sum()) == pytest.approx(1, abs=0.01)
    wide = float((even * square).sum() / even.sum()) / 2
    assert wide == pytest.approx(4.0**2 + 3.0**2, rel=0.03)


@pytest.mark.slow
def test_swirl_that_smooth_smoke_hides_has_large_standard_errors():
    """In noise the cores' errors were 5 times the stated ones in variance, and 1 in 3 beyond 1.96.

    New seeds; within the table's limits and 2 of its own standard errors, as that of a single wake
    tells little.
    """
    found = measured("advected, texture 0 %, noise 0.3 %", "variational", range(71, 75))
    (within, error), (wide, of_wide) = found.coverage_68, found.coverage_95
    assert within > 0.633 - 2 * error and wide > 0.90 - 2 * of_wide
    assert found.variance[0] - 2 * found.variance[1] < 1.25
