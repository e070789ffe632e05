"""Where in a gate the echo comes from, by the signal of the lines. Physics tier.

Detects: ranges that move the wrong way or by another amount, a signal without slope that moves
them, gates without signal that do.
"""

import math

import numpy as np
import pytest
import xarray as xr

from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.ground_vortices.echo import at_the_echo

RANGES = 400.0 + 10 * np.arange(60)
LIDAR = CoherentLidar(pulse_duration=200e-9, gate_length=30.0, first_gate=400.0)
VARIANCE = (200e-9 * 299792458 / 2) ** 2 / (8 * math.log(2)) + 30.0**2 / 12
"""Of the Gaussian pulse and the gate together, m^2."""


def moved(ratio):
    """Change of the ranges, m, by the signal of 40 lines."""
    lines = xr.Dataset({"snr": (("time", "range"), ratio)}, {"range": RANGES})
    return at_the_echo(lines, LIDAR)["range"].values - RANGES


def test_signal_that_falls_with_the_square_of_the_range():
    """-2 variance / range; the last three gates at each end have the slope of the next."""
    found = moved(np.tile(RANGES**-2.0, (40, 1)))
    expected = -2 * VARIANCE / RANGES
    np.testing.assert_allclose(found[4:-4], expected[4:-4], rtol=0.01)
    np.testing.assert_allclose(found, expected, rtol=0.15)


def test_noise_of_the_signal_moves_little():
    """Noise of 20 % of 40 lines, 4 % of medians: means of 7, two gates apart, differ by 1.1 %.

    That is 0.135 m; of 60 gates, one in eight of them independent, to 4 sigma.
    """
    random = np.random.default_rng(1)
    found = moved(0.05 * (1 + 0.2 * random.standard_normal((40, 60))))
    assert 0.135 * 0.25 < np.sqrt(np.mean(found**2)) < 0.135 * 1.75


@pytest.mark.parametrize("ratio", [np.full((40, 60), 0.1), np.full((40, 60), -0.01)])
def test_nothing_moves_without_slope_or_signal(ratio):
    assert moved(ratio) == pytest.approx(0, abs=1e-9)


def test_gates_without_signal_have_that_of_their_neighbours():
    ratio = np.tile(RANGES**-2.0, (40, 1))
    ratio[:, 30] = -1.0
    np.testing.assert_allclose(moved(ratio)[10:50], -2 * VARIANCE / RANGES[10:50], rtol=0.03)


def test_lines_without_signal_stay():
    lines = xr.Dataset(coords={"range": RANGES})
    assert at_the_echo(lines, LIDAR) is lines
