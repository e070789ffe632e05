"""Noise of the radial velocity of a coherent lidar from its signal-to-noise ratio."""

import numpy as np
import scipy

from lidar_mi.errors import InputError

_NODES = np.linspace(-12.0, 12.0, 1201)


def peak_ratio(snr: np.ndarray, width: np.ndarray, bandwidth: float) -> np.ndarray:
    """Peak of the signal's spectrum over that of the noise: SNR B / (sqrt(2 pi) width)."""
    return np.asarray(snr) * bandwidth / (np.sqrt(2 * np.pi) * np.asarray(width))


def rye_hardesty(
    snr: np.ndarray, width: np.ndarray, bandwidth: float, samples: float
) -> np.ndarray:
    """Standard deviation of the velocity, m/s, by an approximation of the Cramér-Rao bound.

    sigma^2 = sqrt(8) width^2 / (alpha N) (1 + alpha / sqrt(2 pi))^2, alpha = `peak_ratio`,
    N = SNR samples (Rye & Hardesty, IEEE Trans. Geosci. Remote Sens. 31, 16-27, 1993, as given by
    O'Connor et al., J. Atmos. Oceanic Technol. 27, 1652-1664, 2010). To 7 % that of `cramer_rao` up
    to alpha = 5; above it, larger.

    Parameters
    ----------
    snr : array
        Ratio of the powers in the bandwidth, above 0.
    width : array
        Standard deviation of the signal's spectrum, m/s.
    bandwidth : float
        Of the receiver as a range of velocities, m/s: twice the largest that is measured.
    samples : float
        Of a gate times pulses.
    """
    _check(snr, width, bandwidth, samples)
    alpha = peak_ratio(snr, width, bandwidth)
    photons = np.asarray(snr) * samples
    return np.sqrt(np.sqrt(8) / (alpha * photons)) * width * (1 + alpha / np.sqrt(2 * np.pi))


def cramer_rao(snr: np.ndarray, width: np.ndarray, bandwidth: float, samples: float) -> np.ndarray:
    """The least standard deviation of the velocity of a Gaussian spectrum in white noise, m/s.

    Of many samples, B width / (samples J) with J = int (x alpha g / (1 + alpha g))^2 dx and
    g = exp(-x^2 / 2) (Whittle's likelihood; Levin, IEEE Trans. Inf. Theory 11, 100-107, 1965).
    Parameters as of `rye_hardesty`.
    """
    _check(snr, width, bandwidth, samples)
    alpha = np.asarray(peak_ratio(snr, width, bandwidth))[..., None]
    shape = np.exp(-(_NODES**2) / 2)
    squares = (_NODES * alpha * shape / (1 + alpha * shape)) ** 2
    information = scipy.integrate.simpson(squares, x=_NODES, axis=-1)
    return np.sqrt(bandwidth * np.asarray(width) / (samples * information))


def _check(snr: np.ndarray, width: np.ndarray, bandwidth: float, samples: float) -> None:
    for name, value in (
        ("snr", snr),
        ("width", width),
        ("bandwidth", bandwidth),
        ("samples", samples),
    ):
        if not (np.asarray(value) > 0).all():
            raise InputError(f"{name}: {np.min(value):g} is not allowed; expected above 0")
