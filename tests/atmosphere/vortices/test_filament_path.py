"""Bent wakes along a flight path, against the straight pair and lines known in closed form.

Physics tier. Detects: a wake that is met elsewhere, turned, or with another circulation or descent
than the straight pair; vortices in a plane that are not where the lines cross it.
"""

import math

import numpy as np
import pytest

from lidar_mi.atmosphere.vortices.crow import PLANE
from lidar_mi.atmosphere.vortices.filament_path import FilamentsAlongPath
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.errors import InputError

PAIR = PairAlongPath(
    400.0,
    separation=40.0,
    core_radius=5.0,
    crossing_angle=0.3,
    climb_angle=-0.05,
    x_c=500.0,
    t_c=6.0,
    miss=(4.0, -3.0),
    decay_time=60.0,
    crow_wavelength=344.0,
    crow_phase=0.7,
    age=20.0,
)


def test_without_waves_it_is_the_pair():
    """Within 1 % of the largest swirl: the table's error."""
    wake, random = FilamentsAlongPath(PAIR, 0.0), np.random.default_rng(1)
    places = np.array(PAIR.centre_at(4.0))[:, None] + random.uniform(-45, 45, (3, 800))
    found, expected = (np.array(one.wind(*places, 4.0)) for one in (wake, PAIR))
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()
    np.testing.assert_allclose(wake.centre_at(1.0), np.array(PAIR.centre_at(1.0)), atol=1e-4)
    for one, other in zip(wake.vortices(480.0, 5.0), PAIR.vortices(480.0, 5.0), strict=True):
        for name in ("circulation", "core_radius", "y", "z"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), abs=1e-4)


def test_vortices_are_where_the_lines_cross_the_plane():
    """The sine in its inclined plane, from the wake's axes; the nodes are 4 m apart."""
    wake = FilamentsAlongPath(PAIR, 12.0)
    along, left, up = PAIR.axes
    for x in (400.0, 520.0, 900.0):
        for side, vortex in zip((1, -1), wake.vortices(x, 5.0), strict=True):
            away = np.array([x, vortex.y, vortex.z]) - wake.centre_at(5.0)
            s, across, above = (float(away @ axis) for axis in (along, left, up))
            size = 12.0 * math.sin(2 * math.pi / 344.0 * s + 0.7)
            assert across == pytest.approx(side * (20 + size * math.cos(PLANE)), abs=0.02)
            assert above == pytest.approx(size * math.sin(PLANE), abs=0.02)
            assert vortex.circulation == pytest.approx(side * 400 * math.exp(-25 / 60))


def test_swirl_about_a_vortex_of_the_plane():
    """At the core radius about each crossing, both sides, it is that of the vortex: within 3 %.

    The partner and the bend of the line are the same on both sides, to first order.
    """
    wake = FilamentsAlongPath(PairAlongPath(400.0, 40.0, 5.0, crow_wavelength=344.0), 10.0)
    for vortex in wake.vortices(86.0, 0.0):  # a crest
        right, left = (wake.wind(86.0, vortex.y + d, vortex.z, 0.0)[2] for d in (5.0, -5.0))
        swirl = 0.7153 * vortex.circulation / (2 * math.pi * 5.0)
        assert (right - left) / 2 == pytest.approx(swirl, rel=0.03)


@pytest.mark.slow
def test_rings():
    """Where a plane cuts a ring there is a pair, and none between rings."""
    wake = FilamentsAlongPath(PairAlongPath(400.0, 40.0, 5.0, crow_wavelength=344.0), 30.0)
    assert wake.rings
    port, starboard = wake.vortices(86.0, 0.0)
    assert port.y == pytest.approx(-starboard.y) and port.y > 20
    assert port.circulation == -starboard.circulation == 400
    with pytest.raises(InputError, match="cuts 0 port and 0 starboard vortices"):
        wake.vortices(86.0 + 172.0, 0.0)
    # air between the halves of a long ring sinks about as between straight vortices so far apart
    sinking = wake.wind(86.0, 0.0, port.z, 0.0)[2]
    assert sinking == pytest.approx(-400 / math.pi / port.y, rel=0.1)


def test_a_mean_wind_is_refused():
    with pytest.raises(InputError, match=r"filaments\.pair: a mean wind"):
        FilamentsAlongPath(PairAlongPath(400.0, mean_wind=(1.0, 0.0)), 3.0)
