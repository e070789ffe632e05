"""Strength of the prior against the largest likelihood of a case solved by hand.

Detects steps that end far from the largest evidence, and a strength that grows for ever.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.velocimetry.flow_spline import Axis
from lidar_mi.retrieval.velocimetry.prior import first_prior
from lidar_mi.retrieval.velocimetry.settings import VariationalSettings

SETTINGS = VariationalSettings()
AXES = [Axis(64, 4.0), Axis(64, 4.0)]


def after(rounds, trusted, squares, noise):
    """Strength where each rate is seen by itself with white noise; its mean square is given.

    One strength for the whole mesh: posterior variance 1 / (L + 1 / noise), mean y / (1 + noise L).
    """
    flow = torch.zeros(2, *(axis.knots for axis in AXES), dtype=torch.float64)
    prior = first_prior(AXES, flow, 1e3, (1.0, 1.0), SETTINGS)
    for _ in range(rounds):
        strength = prior.strength
        posterior = 1 / (strength + 1 / noise)
        energy = squares / (1 + noise * strength) ** 2
        prior = prior.updated(1 / strength - posterior, energy, SETTINGS, trusted)
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
