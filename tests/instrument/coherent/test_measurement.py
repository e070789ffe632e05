"""Lines that a coherent lidar measures. Physics tier.

Detects: noise of another size than stated, or independent where gates overlap; lines from which the
wind does not come back within its errors.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.instrument.coherent.measurement import Receiver, measured_lines
from lidar_mi.instrument.coherent.scans import ppi_scan, stare_scan
from lidar_mi.instrument.coherent.weighting import CoherentLidar


def wind(x, y, z, time):
    return 3.0 + 0.01 * z, -5.0 + 0 * z, 0.2 + 0 * z


def test_noise_is_as_stated_and_shared_by_gates_that_overlap():
    lidar = CoherentLidar(gates=12, gate_step=10.0)
    lines = measured_lines(wind, stare_scan(0.0, 1.0, 1.0, 2000), lidar, 0.02, resolution=5.0)
    z = (lines["radial_velocity"] - lines["radial_velocity_true"]) / lines["radial_velocity_stderr"]
    assert float(z.std()) == pytest.approx(1, abs=4 * np.sqrt(3 / 2 / z.size))
    for lag, expected in ((1, 2 / 3), (2, 1 / 3), (3, 0.0), (5, 0.0)):
        found = float((z.values[:, lag:] * z.values[:, :-lag]).mean())
        assert found == pytest.approx(expected, abs=4 * np.sqrt(2 / 2000))


def test_the_wind_of_a_simulated_scan_comes_back():
    """Within its errors, and to centimetres per second."""
    scan = ppi_scan(np.deg2rad(60), (0.0, 2 * np.pi), np.deg2rad(15), 2.0)
    lidar = CoherentLidar(gates=8)
    z = []
    for seed in range(15):
        lines = measured_lines(wind, scan, lidar, lambda r: 0.1 * (500 / r) ** 2, seed=seed)
        winds = lm.fit_winds_to_lines(lines).isel(time=0)
        height = winds["height"].values
        # the beam moves by 30 degrees in a line: the velocity is the mean over them
        smear = np.sinc(np.deg2rad(30) / 2 / np.pi)
        truth = (smear * (3 + 0.01 * height), -5.0 * smear, 0.2)
        for name, known in zip("uvw", truth, strict=True):
            z.append((winds[name].values - known) / winds[f"{name}_stderr"].values)
    z = np.abs(np.array(z))
    # in air without turbulence, which is never excluded, errors are rather too large
    assert 0.65 < (z < 1).mean() < 0.92 and (z < 1.96).mean() > 0.93


def test_a_signal_that_is_not_allowed():
    scan, lidar = stare_scan(0.0, 1.0, 1.0, 2), CoherentLidar(gates=3)
    with pytest.raises(lm.InputError, match="snr: -1 is not allowed"):
        measured_lines(wind, scan, lidar, -1.0)
    with pytest.raises(lm.InputError, match=r"snr: shape \(2,\)"):
        measured_lines(wind, scan, lidar, np.ones(2))


def test_without_a_signal_velocities_are_uniform_and_flagged():
    """Half of the gates at -60 dB: the bound would be thousands of m/s."""
    lidar = CoherentLidar(gates=8)
    snr = np.where(np.arange(8) < 4, 0.1, 1e-6)
    scan = stare_scan(0.0, 1.0, 1.0, 500)
    lines = measured_lines(wind, scan, lidar, snr, Receiver(bandwidth=40.0))
    assert (lines["flag"].values == (np.arange(8) >= 4)).all()
    lost = lines["radial_velocity"].values[:, 4:]
    assert np.abs(lost).max() < 20
    # of a uniform number, mean square 1/3 and variance of the square 4/45
    assert (lost**2).mean() / 400 == pytest.approx(1 / 3, abs=4 * np.sqrt(4 / 45 / lost.size))
    np.testing.assert_allclose(lines["radial_velocity_stderr"][:, 4:], 40 / np.sqrt(12))
