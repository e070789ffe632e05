"""Radial velocities of a coherent lidar. Physics tier.

Detects: a projection with a wrong sign or axis, a range weighting of another shape, a quadrature
that does not resolve a vortex, a line at another time or direction.
"""

from itertools import pairwise

import numpy as np
import pytest
import scipy

from lidar_mi.atmosphere.vortices.vortex import angular_velocity
from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.scans import dbs_scan, directions, ppi_scan, rhi_scan, stare_scan
from lidar_mi.instrument.coherent.weighting import (
    CoherentLidar,
    echo_shift,
    gate_moments,
    range_weight,
)

LIDAR = CoherentLidar(gate_length=30.0, first_gate=105.0, gate_step=10.0, gates=80)


def uniform(x, y, z, time):
    return 3.0 + 0 * x, -5.0 + 0 * x, 0.4 + 0 * x


def test_a_uniform_wind_is_projected():
    scan = ppi_scan(np.deg2rad(35), (0.0, 2 * np.pi), np.deg2rad(10), 1.0)
    assert len(scan.time) == 36
    found, spread, _ = gate_moments(uniform, scan, LIDAR)
    a, e = scan.azimuth, scan.elevation
    # the mean over the angle that a beam moves through
    smear = np.sinc(scan.azimuth_span / 2 / np.pi)
    expected = smear * (3 * np.sin(a) - 5 * np.cos(a)) * np.cos(e) + 0.4 * np.sin(e)
    assert found.shape == (36, 80)
    np.testing.assert_allclose(found, np.repeat(expected[:, None], 80, 1), atol=1e-9)
    # of the speed across, sqrt(34) m/s cos(35 degrees), over 10 degrees
    limit = np.hypot(3, 5) * np.cos(e[0]) * scan.azimuth_span / np.sqrt(12)
    assert spread.max() < 1.01 * limit


def test_linear_shear_is_measured_at_the_middle_of_the_gate():
    def wind(x, y, z, time):
        return 0.05 * z, 0 * z, 0 * z

    scan = stare_scan(np.pi / 2, np.deg2rad(30), 1.0, 2)
    found, spread, _ = gate_moments(wind, scan, LIDAR)
    expected = 0.05 * LIDAR.ranges * np.sin(np.deg2rad(30)) * np.cos(np.deg2rad(30))
    np.testing.assert_allclose(found[0], expected, atol=1e-6)
    # variance of the weight: of the pulse and of the window
    sigma2 = LIDAR.pulse_length**2 / (8 * np.log(2)) + LIDAR.gate_length**2 / 12
    slope = 0.05 * np.sin(np.deg2rad(30)) * np.cos(np.deg2rad(30))
    np.testing.assert_allclose(spread, slope * np.sqrt(sigma2), rtol=1e-4)


def by_quadrature(profile, middle):
    """The weighted mean along a line by adaptive quadrature."""
    edges = [middle - 100.0, *middle + np.linspace(-60, 60, 25), middle + 100.0]
    return sum(
        scipy.integrate.quad(
            lambda r: range_weight(np.array(r - middle), LIDAR) * profile(r), a, b, epsabs=1e-10
        )[0]
        for a, b in pairwise(edges)
    )


def test_a_power_law_is_that_of_quadrature():
    sine, cosine = np.sin(np.deg2rad(20)), np.cos(np.deg2rad(20))

    def wind(x, y, z, time):
        return 0 * z, 8 * (np.maximum(z, 0) / 10) ** 0.2, 0 * z

    found, *_ = gate_moments(wind, stare_scan(0.0, np.deg2rad(20), 1.0, 1), LIDAR)
    for gate in (0, 5, 40):
        expected = by_quadrature(
            lambda r: 8 * (max(r * sine, 0.0) / 10) ** 0.2 * cosine, LIDAR.ranges[gate]
        )
        assert found[0, gate] == pytest.approx(expected, abs=1e-3)


def test_a_vortex_is_that_of_quadrature():
    """Lamb-Oseen, core 3 m, 500 m away and 60 m high, crossed in a slice of 0.5 degrees a line."""
    circulation, core, place = 400.0, 3.0, (500.0, 60.0)

    def swirl(x, z):
        dx, dz = x - place[0], z - place[1]
        rate = angular_velocity(dx**2 + dz**2, circulation, core)
        return -rate * dz, rate * dx

    def wind(x, y, z, time):
        u, w = swirl(x, z)
        return u, 0 * x, w

    scan = rhi_scan(np.pi / 2, (0.0, np.deg2rad(15)), np.deg2rad(2), 0.25)
    still = type(scan)(scan.time, scan.azimuth, scan.elevation, scan.sweep)
    found, *_ = gate_moments(wind, still, LIDAR)
    assert len(scan.time) == 30 and np.abs(found).max() > 3.5
    line = directions(still.azimuth, still.elevation)
    for number in (8, 13, 14):
        for gate in (36, 39, 42):

            def along(r, d=line[number]):
                u, w = swirl(r * d[0], r * d[2])
                return float(u * d[0] + w * d[2])

            expected = by_quadrature(along, LIDAR.ranges[gate])
            assert found[number, gate] == pytest.approx(expected, abs=1e-3)


def test_the_weight_is_normalised_and_a_window_without_a_pulse():
    total, _ = scipy.integrate.quad(lambda r: float(range_weight(np.array(r), LIDAR)), -200, 200)
    assert total == pytest.approx(1, abs=1e-9)
    short = CoherentLidar(pulse_duration=1e-12)
    found = range_weight(np.array([0.0, 14.9, 15.1]), short)
    np.testing.assert_allclose(found, [1 / 30, 1 / 30, 0])


def test_times_and_directions_of_scans():
    rhi = rhi_scan(0.5, (0.1, 0.2), 0.01, 1.0, count=2, turn=3.0)
    np.testing.assert_allclose(rhi.time, [*np.arange(0.5, 10), *np.arange(13.5, 23)])
    np.testing.assert_allclose(rhi.elevation[:10], np.linspace(0.105, 0.195, 10))
    np.testing.assert_allclose(rhi.elevation[10:], np.linspace(0.195, 0.105, 10))
    assert rhi.sweep.tolist() == [0] * 10 + [1] * 10
    dbs = dbs_scan(1.2, 1.0, move=3.0, count=2)
    np.testing.assert_allclose(dbs.time, 4 * np.arange(10) + 0.5)
    np.testing.assert_allclose(directions(dbs.azimuth, dbs.elevation)[4], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(directions(np.pi / 2, 0.0), [1, 0, 0], atol=1e-12)  # east
    with pytest.raises(InputError, match=r"scan.rate: 0"):
        rhi_scan(0.0, (0.0, 1.0), 0.0, 1.0)
    with pytest.raises(InputError, match="expected one line or more"):
        ppi_scan(0.0, (0.0, 0.001), 1.0, 1.0)
    with pytest.raises(InputError, match=r"lidar.first_gate: 10 m"):
        CoherentLidar(first_gate=10.0)


def test_where_the_echo_of_a_gate_is():
    """Of a signal exp(k r) the weighted wind r is that at r + variance k, to first order in k."""
    lidar = CoherentLidar(first_gate=300.0, gate_step=10.0, gates=30)
    slope = -0.004

    def wind(x, y, z, time):
        return np.zeros_like(y), y, np.zeros_like(y)

    def signal(x, y, z, time):
        return np.exp(slope * (y - 300))

    found, _, power = gate_moments(wind, stare_scan(0.0, 0.0, 1.0, 1), lidar, signal=signal)
    shift = echo_shift(lidar.ranges, power[0], lidar)
    assert shift[10] == pytest.approx(slope * (30**2 / 12 + (lidar.pulse_length / 2.354820) ** 2))
    np.testing.assert_allclose(found[0], lidar.ranges + shift, atol=0.02)
    # without a signal, power is 1 everywhere
    assert gate_moments(wind, stare_scan(0.0, 0.0, 1.0, 1), lidar)[2] == pytest.approx(1.0)
