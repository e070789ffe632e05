"""A discrete-time filter with coloured noise, identified from input and output.

y_k = c + h_0 u_k + ... + h_{m-1} u_{k-m+1} + n_k,   n_k = a_1 n_{k-1} + ... + a_p n_{k-p} + e_k,

with white e. Filter and noise are estimated in turn: the filter by least squares of input and
output that the noise model whitens, the noise by Burg's method from what the filter leaves. This is
generalised least squares (Cochrane and Orcutt, J. Am. Stat. Assoc. 44, 32-61, 1949; Ljung, System
Identification, 1999, section 7.3). Burg's models are stable (Kay, Modern Spectral Estimation, 1988,
section 7.5). The numbers m and p have the smallest information criterion of Schwarz (Ann. Stat. 6,
461-464, 1978).
"""

from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.errors import InputError

MOST_TAPS, MOST_LAGS = 3, 4
MOST_PROCESS_LAGS = 8
LEAST_SAMPLES = 50
"""Of one output, below which nothing is identified."""

_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class FilterFit:
    """A filter and its noise.

    Attributes
    ----------
    taps, taps_covariance : ndarray, shape (m,) and (m, m)
        h.
    offset, offset_stderr : float
        c.
    lags, lags_covariance : ndarray, shape (p,) and (p, p)
        a.
    innovations : ndarray, shape (n,)
        e; NaN where input or output are missing.
    innovation_variance : float
    count : int
        Innovations.
    """

    taps: np.ndarray
    taps_covariance: np.ndarray
    offset: float
    offset_stderr: float
    lags: np.ndarray
    lags_covariance: np.ndarray
    innovations: np.ndarray
    innovation_variance: float
    count: int

    @property
    def gain(self) -> tuple[float, float]:
        """Of a constant input, with its standard error."""
        return float(self.taps.sum()), float(np.sqrt(self.taps_covariance.sum()))

    @property
    def noise_variance(self) -> tuple[float, float]:
        """Of n, with its standard error (Bartlett: 2/N sum over all lags of squared covariances).

        The sum of squares is the integral of the squared spectrum.
        """
        frequency = (np.arange(4096) + 0.5) / 8192
        spectrum = self.noise_spectrum(frequency)[0]
        variance = autocovariance(self.lags, self.innovation_variance, 1)[0]
        return float(variance), float(np.sqrt(2 / self.count * np.mean(spectrum**2)))

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Of the filter at frequencies in cycles a sample."""
        return np.exp(-2j * np.pi * np.outer(frequency, np.arange(len(self.taps)))) @ self.taps

    def response_stderr(self, frequency: np.ndarray) -> np.ndarray:
        """Standard error of the response, of real and imaginary part together."""
        waves = np.exp(-2j * np.pi * np.outer(frequency, np.arange(len(self.taps))))
        return np.sqrt(np.einsum("fi,ij,fj->f", waves, self.taps_covariance, waves.conj()).real)

    def noise_spectrum(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Two-sided density of n per cycle a sample, and its standard error to first order."""
        waves = np.exp(-2j * np.pi * np.outer(frequency, np.arange(1, len(self.lags) + 1)))
        denominator = 1 - waves @ self.lags
        density = self.innovation_variance / np.abs(denominator) ** 2
        slopes = 2 * (waves / denominator[:, None]).real  # of the logarithm, per lag
        relative = 2 / self.count + np.einsum("fi,ij,fj->f", slopes, self.lags_covariance, slopes)
        return density, density * np.sqrt(relative)


def fit_filter(output: np.ndarray, value: np.ndarray) -> FilterFit:
    """The filter and its noise with the numbers of taps and lags that the data support.

    Parameters
    ----------
    output, value : ndarray, shape (n,)
        y and the input u, sample by sample; NaN where there is none, as between two records.

    Raises
    ------
    InputError
        Fewer than `LEAST_SAMPLES` samples that have all inputs and outputs before them.
    """
    # all models are compared on the samples that the longest one has
    usable = _whole(output, value, MOST_TAPS, MOST_LAGS)
    if usable.sum() < LEAST_SAMPLES:
        raise InputError(
            f"{int(usable.sum())} slabs in succession with a valid wind are too few to identify a "
            f"filter; expected {LEAST_SAMPLES} or more, as of longer flights or of several"
        )
    found, least = None, np.inf
    for taps in range(1, MOST_TAPS + 1):
        for lags in range(MOST_LAGS + 1):
            fit = _fitted(output, value, taps, lags)
            errors = fit.innovations[usable]
            number = len(errors)
            criterion = number * np.log(np.mean(errors**2)) + (taps + lags) * np.log(number)
            if criterion < least:
                found, least = fit, criterion
    assert found is not None  # the criterion of finite data is finite
    return found


def fit_process(values: np.ndarray) -> tuple[np.ndarray, float]:
    """An autoregressive model of a process: its lags, and the variance of its innovations.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Without a mean; NaN between two records. There are many more than `MOST_PROCESS_LAGS`.
    """
    usable = _whole(values, values, 1, MOST_PROCESS_LAGS)
    found, least = (np.zeros(0), 0.0), np.inf
    for number in range(MOST_PROCESS_LAGS + 1):
        lags = burg(values, number)
        variance = float(np.mean(_whitened(values, lags)[usable] ** 2))
        criterion = usable.sum() * np.log(variance) + number * np.log(usable.sum())
        if criterion < least:
            found, least = (lags, variance), criterion
    return found


def autocovariance(lags: np.ndarray, innovation_variance: float, number: int) -> np.ndarray:
    """Of an autoregressive process, at 0 to number - 1 samples; (number,).

    From the Yule-Walker equations, continued by the recursion.
    """
    p = len(lags)
    if p == 0:
        return np.concatenate([[innovation_variance], np.zeros(max(0, number - 1))])[:number]
    companion = np.vstack([lags, np.eye(p - 1, p)])
    drive = np.zeros((p, p))
    drive[0, 0] = innovation_variance
    first = scipy.linalg.solve_discrete_lyapunov(companion, drive)[0]
    found = list(first)
    while len(found) < number:
        found.append(float(lags @ found[: -p - 1 : -1]))
    return np.array(found[:number])


def _fitted(output: np.ndarray, value: np.ndarray, taps: int, lags: int) -> FilterFit:
    inputs = np.stack([np.ones(len(value)), *(_delayed(value, k) for k in range(taps))], axis=-1)
    a = np.zeros(0)
    for _ in range(_ROUNDS):
        white, design = _whitened(output, a), _whitened(inputs, a)
        there = np.isfinite(white) & np.isfinite(design).all(axis=-1)
        h = np.linalg.lstsq(design[there], white[there], rcond=None)[0]
        before, a = a, burg(output - inputs @ h, lags)
        if len(before) == lags and np.allclose(a, before, rtol=0, atol=1e-6):
            break
    errors = np.where(there, white - design @ h, np.nan)
    count = int(there.sum())
    variance = float(np.nansum(errors**2) / (count - taps - 1 - lags))
    covariance = variance * np.linalg.inv(design[there].T @ design[there])
    noise = scipy.linalg.toeplitz(autocovariance(a, variance, lags)) if lags else np.zeros((0, 0))
    return FilterFit(
        h[1:],
        covariance[1:, 1:],
        float(h[0]),
        float(np.sqrt(covariance[0, 0])),
        a,
        variance / count * np.linalg.inv(noise),
        errors,
        variance,
        count,
    )


def burg(values: np.ndarray, lags: int) -> np.ndarray:
    """Coefficients a of n_k = sum a_i n_{k-i} + e_k by Burg's method; (lags,).

    Parameters
    ----------
    values : ndarray, shape (n,)
        NaN between records, whose sums are added.
    lags : int
    """
    forward = backward = values
    a = np.zeros(0)
    for _ in range(lags):
        forward, backward = forward[1:], backward[:-1]
        there = np.isfinite(forward) & np.isfinite(backward)
        f, b = forward[there], backward[there]
        k = 2 * (f @ b) / (f @ f + b @ b)
        a = np.concatenate([a - k * a[::-1], [k]])
        forward, backward = forward - k * backward, backward - k * forward
    return a


def _delayed(values: np.ndarray, by: int) -> np.ndarray:
    found = np.full(values.shape, np.nan)
    found[by:] = values[: len(values) - by]
    return found


def _whitened(values: np.ndarray, lags: np.ndarray) -> np.ndarray:
    found = values.copy()
    for k, a in enumerate(lags, 1):
        found -= a * _delayed(values, k)
    return found


def _whole(output: np.ndarray, value: np.ndarray, taps: int, lags: int) -> np.ndarray:
    """Samples with the outputs of all lags and the inputs of all taps and lags before them."""
    needed = [_delayed(output, k) for k in range(lags + 1)]
    needed += [_delayed(value, k) for k in range(taps + lags)]
    return np.asarray(np.isfinite(needed).all(axis=0))
