"""Decay in turbulence against its published laws. Physics tier.

Detects: a branch or unit of the law that is wrong, a jump between branches.
"""

import math

import pytest

from lidar_mi.atmosphere.vortices.wake_decay import sarpkaya_decay_time, sarpkaya_time
from lidar_mi.errors import InputError


@pytest.mark.parametrize("dissipation", [0.02, 0.1, 0.25])
def test_moderate_turbulence(dissipation):
    """eps* = T^(1/4) exp(-0.70 T)."""
    time = sarpkaya_time(dissipation)
    assert time**0.25 * math.exp(-0.70 * time) == pytest.approx(dissipation)


def test_strong_and_weak_turbulence():
    assert 0.5 * sarpkaya_time(0.5) ** (4 / 3) == pytest.approx(0.7475)
    assert sarpkaya_time(0.005) == pytest.approx(8.28)
    assert sarpkaya_time(0.0) == pytest.approx(9.0)


@pytest.mark.parametrize("edge", [0.001, 0.0121, 0.2535])
def test_the_branches_of_the_law_meet(edge):
    """The published constants have three to four digits."""
    below, above = (sarpkaya_time(edge * (1 + d)) for d in (-1e-6, 1e-6))
    assert below == pytest.approx(above, rel=2e-3)


def test_a_negative_rate_is_refused():
    with pytest.raises(InputError, match="dissipation rate: -1"):
        sarpkaya_decay_time(400.0, 47.1, -1.0)
