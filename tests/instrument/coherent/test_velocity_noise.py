"""Noise of radial velocities. Physics tier.

Detects: a bound that is not that of simulated spectra, a formula with a wrong factor.
"""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.velocity_noise import cramer_rao, peak_ratio
from lidar_mi.instrument.coherent.weighting import CoherentLidar

BANDWIDTH, WIDTH = 38.8, 1.5


def rye_hardesty(snr, width, bandwidth, samples):
    """Their approximation of the bound (1993), as given by O'Connor et al. (2010)."""
    alpha = peak_ratio(snr, width, bandwidth)
    factor = np.sqrt(np.sqrt(8) / (alpha * snr * samples))
    return factor * width * (1 + alpha / np.sqrt(2 * np.pi))


def test_both_agree_where_the_signal_is_weak():
    """To first order in SNR the approximation is the bound: 2 / sqrt(pi) B width / (n alpha^2)."""
    snr = np.array([1e-3, 3e-3])
    alpha = snr * BANDWIDTH / np.sqrt(2 * np.pi) / WIDTH
    limit = np.sqrt(2 / np.sqrt(np.pi) * BANDWIDTH * WIDTH / 1e5) / alpha
    np.testing.assert_allclose(cramer_rao(snr, WIDTH, BANDWIDTH, 1e5), limit, rtol=0.04)
    np.testing.assert_allclose(rye_hardesty(snr, WIDTH, BANDWIDTH, 1e5), limit, rtol=0.04)


def test_the_approximation_is_near_the_bound_and_above_it_where_the_signal_is_strong():
    """Speckle alone: the approximation tends to a constant, the bound still falls slowly."""
    snr = np.geomspace(1e-3, 10, 30)
    ratio = rye_hardesty(snr, WIDTH, BANDWIDTH, 1e5) / cramer_rao(snr, WIDTH, BANDWIDTH, 1e5)
    weak = peak_ratio(snr, WIDTH, BANDWIDTH) < 5
    assert (np.abs(ratio[weak] - 1) < 0.07).all() and (np.diff(ratio[~weak]) > 0).all()
    assert ratio[-1] > 1.5


@pytest.mark.parametrize("snr", [0.02, 0.2, 2.0])
def test_maximum_likelihood_of_simulated_spectra_reaches_the_bound(snr):
    """Periodograms are exponential about a Gaussian line in white noise (Whittle)."""
    random = np.random.default_rng(4)
    lines, pulses, trials = 256, 400, 400
    velocity = (np.arange(lines) - lines / 2) * BANDWIDTH / lines
    peak = snr * BANDWIDTH / np.sqrt(2 * np.pi) / WIDTH
    shifts = np.linspace(-3, 3, 601)
    models = 1 + peak * np.exp(-((velocity - shifts[:, None]) ** 2) / 2 / WIDTH**2)
    spectra = random.gamma(pulses, size=(trials, lines)) / pulses * models[300]
    cost = spectra @ (1 / models).T + np.log(models).sum(1)
    best = cost.argmin(1)
    # a parabola through the least three
    left, here, right = (np.take_along_axis(cost, (best + k)[:, None], 1)[:, 0] for k in (-1, 0, 1))
    found = shifts[best] + 0.01 * (left - right) / (2 * (left - 2 * here + right))
    bound = float(cramer_rao(snr, WIDTH, BANDWIDTH, lines * pulses))
    # a standard deviation of 400 numbers: to 1 / sqrt(800); the estimate is efficient
    assert found.std() == pytest.approx(bound, rel=4 / np.sqrt(2 * trials) + 0.02)


def test_the_spectrum_of_the_pulse():
    """Of the field of a Gaussian pulse, by its Fourier transform."""
    lidar = CoherentLidar()
    time = np.linspace(-2e-6, 2e-6, 8001)
    sigma = lidar.pulse_duration / np.sqrt(8 * np.log(2))
    field = np.exp(-(time**2) / (4 * sigma**2))
    frequency = np.fft.fftfreq(time.size, time[1] - time[0])
    power = np.abs(np.fft.fft(field)) ** 2
    rms = np.sqrt((power * frequency**2).sum() / power.sum())
    assert lidar.pulse_width == pytest.approx(lidar.wavelength / 2 * rms, rel=1e-6)


def test_values_out_of_range():
    with pytest.raises(InputError, match="snr: 0 is not allowed"):
        cramer_rao(np.array([0.1, 0.0]), WIDTH, BANDWIDTH, 1e4)
