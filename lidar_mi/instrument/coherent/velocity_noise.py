"""Noise of the radial velocity of a coherent lidar from its signal-to-noise ratio."""

import numpy as np
import scipy

from lidar_mi.errors import InputError

_NODES = np.linspace(-12.0, 12.0, 1201)
_MANY = 200  # ratios, above which they are interpolated


def peak_ratio(snr: np.ndarray, width: np.ndarray, bandwidth: float) -> np.ndarray:
    """Peak of the signal's spectrum over that of the noise: SNR B / (sqrt(2 pi) width)."""
    return np.asarray(snr) * bandwidth / (np.sqrt(2 * np.pi) * np.asarray(width))


def cramer_rao(snr: np.ndarray, width: np.ndarray, bandwidth: float, samples: float) -> np.ndarray:
    """The least standard deviation of the velocity of a Gaussian spectrum in white noise, m/s.

    For many samples, its square is B width / (samples J) with J = int (x alpha g / (1 + alpha g))^2
    dx and g = exp(-x^2 / 2) (Whittle's likelihood; Levin, IEEE Trans. Inf. Theory 11, 100-107,
    1965).

    snr: ratio of the powers in the bandwidth, above 0.
    width: standard deviation of the signal's spectrum, m/s.
    bandwidth: of the receiver as a range of velocities, m/s: twice the largest that is measured.
    samples: of a gate times pulses.
    """
    _check(snr, width, bandwidth, samples)
    alpha = np.asarray(peak_ratio(snr, width, bandwidth))
    information = _information(alpha.ravel()).reshape(alpha.shape)
    return np.sqrt(bandwidth * np.asarray(width) / (samples * information))


def random_velocity(bandwidth: float) -> float:
    """Standard deviation (m/s) of a velocity that is uniform over the bandwidth.

    An estimate without a signal has this one.
    """
    return bandwidth / np.sqrt(12.0)


def _information(alpha: np.ndarray) -> np.ndarray:
    """J (n,) of the peak ratios (n,); of many, by a spline of its logarithm, to 1e-6."""
    if alpha.size > _MANY:
        low, high = np.log(alpha.min()), np.log(alpha.max())
        nodes = np.linspace(low - 0.1, high + 0.1, _MANY)
        spline = scipy.interpolate.CubicSpline(nodes, np.log(_information(np.exp(nodes))))
        return np.asarray(np.exp(spline(np.log(alpha))))
    shape = np.exp(-(_NODES**2) / 2)
    squares = (_NODES * alpha[:, None] * shape / (1 + alpha[:, None] * shape)) ** 2
    return np.asarray(scipy.integrate.simpson(squares, x=_NODES, axis=-1))


def _check(snr: np.ndarray, width: np.ndarray, bandwidth: float, samples: float) -> None:
    for name, value in (
        ("snr", snr),
        ("width", width),
        ("bandwidth", bandwidth),
        ("samples", samples),
    ):
        if not (np.asarray(value) > 0).all():
            raise InputError(f"{name}: {np.min(value):g} is not allowed; expected above 0")
