"""A discrete-time filter with coloured noise, identified from input and output.

y_k = c + G sum_j h_j u_{k-j} + n_k,   n_k = a_1 n_{k-1} + ... + a_p n_{k-p} + e_k,   sum_j h_j = 1,

with white e. The weights fall by the factor r per sample before (j > 0), as those of a recursive
filter do, and by s per sample after (j < 0), as of an average about the sample. The filter is
estimated by least squares of input and output that the noise model whitens, the noise by Burg's
method from what the filter leaves, in turn. This is generalised least squares (Cochrane and Orcutt,
J. Am. Stat. Assoc. 44, 32-61, 1949; Ljung, System Identification, 1999, section 7.3). Burg's models
are stable (Kay, Modern Spectral Estimation, 1988, section 7.5). The number p has the smallest
information criterion of Schwarz (Ann. Stat. 6, 461-464, 1978).
"""

from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.errors import InputError

BEFORE = 8
"""Samples before a sample that have a weight."""

MOST_LAGS, MOST_PROCESS_LAGS = 4, 8
LEAST_SAMPLES = 50
"""Outputs below which nothing is identified."""

_ROUNDS = 20
_LARGEST_DECAY = 0.8  # of which `BEFORE` samples hold 87 %


@dataclass(frozen=True, eq=False)
class FilterFit:
    """A filter and its noise.

    parameters, covariance (4,) and (4, 4): c, G, r, s. A decay at the edge of what is allowed, 0,
        has no error.
    after: samples after a sample that have a weight.
    lags, lags_covariance (p,) and (p, p): a.
    innovations (n,): e; NaN where input or output are missing.
    count: innovations.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    after: int
    lags: np.ndarray
    lags_covariance: np.ndarray
    innovations: np.ndarray
    innovation_variance: float
    count: int

    @property
    def taps(self) -> np.ndarray:
        """G h_j for j from -after to `BEFORE`."""
        _, gain, before, ahead = self.parameters
        return gain * _weights(before, ahead, self.after)

    @property
    def taps_covariance(self) -> np.ndarray:
        """Of `taps`, to first order."""
        slopes = self._slopes()
        return slopes @ self.covariance[1:, 1:] @ slopes.T

    @property
    def noise_variance(self) -> tuple[float, float]:
        """Of n, with its standard error (Bartlett: 2/N sum over all lags of squared covariances).

        The sum of squares is the integral of the squared spectrum.
        """
        frequency = (np.arange(4096) + 0.5) / 8192
        spectrum = self.noise_spectrum(frequency)[0]
        variance = autocovariance(self.lags, self.innovation_variance, 1)[0]
        return float(variance), float(np.sqrt(2 / self.count * np.mean(spectrum**2)))

    def response(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the filter at frequencies in cycles a sample, and the standard error of both parts."""
        number = np.arange(-self.after, BEFORE + 1)
        waves = np.exp(-2j * np.pi * np.outer(frequency, number))
        stderr = np.einsum("fi,ij,fj->f", waves, self.taps_covariance, waves.conj()).real
        return waves @ self.taps, np.sqrt(np.maximum(stderr, 0.0))

    def noise_spectrum(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Two-sided density of n per cycle a sample, and its standard error to first order."""
        waves = np.exp(-2j * np.pi * np.outer(frequency, np.arange(1, len(self.lags) + 1)))
        denominator = 1 - waves @ self.lags
        density = self.innovation_variance / np.abs(denominator) ** 2
        slopes = 2 * (waves / denominator[:, None]).real  # of the logarithm, per lag
        relative = 2 / self.count + np.einsum("fi,ij,fj->f", slopes, self.lags_covariance, slopes)
        return density, density * np.sqrt(relative)

    def _slopes(self) -> np.ndarray:
        """Of `taps` by G, r and s; (taps, 3)."""
        gain, decays = self.parameters[1], list(self.parameters[2:])
        slopes = [_weights(decays[0], decays[1], self.after)]
        step = 1e-5
        for k in (0, 1):
            # inward: a decay may be at an edge
            other = decays.copy()
            other[k] += step if decays[k] < _LARGEST_DECAY / 2 else -step
            change = _weights(other[0], other[1], self.after) - slopes[0]
            slopes.append(gain * change / (other[k] - decays[k]))
        return np.stack(slopes, axis=-1)


def fit_filter(output: np.ndarray, value: np.ndarray, after: int) -> FilterFit:
    """The filter and its noise, with the number of lags that the data support.

    output, value (n,): y and the input u, sample by sample; NaN where there is none. Two records
        are parted by `BEFORE` samples or more without output.
    after: samples after a sample that may have a weight.

    Raises InputError: fewer than `LEAST_SAMPLES` samples that have all inputs and outputs before
    them.
    """
    # all models are compared on the samples that the longest one has
    usable = np.isfinite([_delayed(output, k) for k in range(MOST_LAGS + 1)]).all(axis=0)
    if usable.sum() < LEAST_SAMPLES:
        raise InputError(
            f"{int(usable.sum())} slabs in succession with a valid wind are too few to identify a "
            f"filter; expected {LEAST_SAMPLES} or more, as of longer flights or of several"
        )
    best, least = None, np.inf
    for lags in range(MOST_LAGS + 1):
        fit = _fitted(output, value, after, lags)
        number = int(usable.sum())
        criterion = number * np.log(np.mean(fit.innovations[usable] ** 2)) + lags * np.log(number)
        if criterion < least:
            best, least = fit, criterion
    assert best is not None  # the criterion of finite data is finite
    return best


def fit_process(values: np.ndarray) -> tuple[np.ndarray, float]:
    """An autoregressive model of a process: its lags, and the variance of its innovations.

    values (n,): without a mean; NaN between two records. There are many more than
        `MOST_PROCESS_LAGS`.
    """
    before = [_delayed(values, k) for k in range(MOST_PROCESS_LAGS + 1)]
    usable = np.isfinite(before).all(axis=0)
    best, least = (np.zeros(0), 0.0), np.inf
    for number in range(MOST_PROCESS_LAGS + 1):
        lags = burg(values, number)
        variance = float(np.mean(_whitened(values, lags)[usable] ** 2))
        criterion = usable.sum() * np.log(variance) + number * np.log(usable.sum())
        if criterion < least:
            best, least = (lags, variance), criterion
    return best


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
    covariances = list(first)
    while len(covariances) < number:
        covariances.append(float(lags @ covariances[: -p - 1 : -1]))
    return np.array(covariances[:number])


def _weights(before: float, ahead: float, after: int) -> np.ndarray:
    """h_j for j from -after to `BEFORE`."""
    weights = np.concatenate(
        [ahead ** np.arange(after, 0, -1.0), before ** np.arange(0.0, BEFORE + 1)]
    )
    return weights / weights.sum()


def _fitted(output: np.ndarray, value: np.ndarray, after: int, lags: int) -> FilterFit:
    around = np.stack([_delayed(value, k) for k in range(-after, BEFORE + 1)], axis=-1)
    a = np.zeros(0)
    # the mean error and gain of least squares without memory
    parameters = np.array([0.0, 1.0, 0.2, 0.2])
    for _ in range(_ROUNDS):
        white, design, ones = (_whitened(one, a) for one in (output, around, np.ones(len(output))))
        there = np.isfinite(white) & np.isfinite(design).all(axis=-1)

        def errors(
            theta: np.ndarray, y: np.ndarray, x: np.ndarray, constant: np.ndarray
        ) -> np.ndarray:
            return y - theta[0] * constant - x @ (theta[1] * _weights(theta[2], theta[3], after))

        edges = (
            np.array([-np.inf, -np.inf, 0, 0]),
            np.array([np.inf, np.inf, *2 * [_LARGEST_DECAY]]),
        )
        inside = np.clip(parameters, edges[0] + 1e-3, edges[1] - 1e-3)
        data = white[there], design[there], ones[there]
        solution = scipy.optimize.least_squares(errors, inside, bounds=edges, args=data)
        parameters = solution.x
        before, a = a, burg(errors(parameters, output, around, np.ones(len(output))), lags)
        if len(before) == lags and np.allclose(a, before, rtol=0, atol=1e-5):
            break
    innovations = np.full(len(output), np.nan)
    innovations[there] = solution.fun
    count = int(there.sum())
    variance = float(np.sum(solution.fun**2) / (count - len(parameters) - lags))
    noise = scipy.linalg.toeplitz(autocovariance(a, variance, lags)) if lags else np.zeros((0, 0))
    free = np.flatnonzero([True, True, *(parameters[2:] > 1e-3)])
    covariance = np.zeros((4, 4))
    jacobian = solution.jac[:, free]
    covariance[np.ix_(free, free)] = variance * np.linalg.inv(jacobian.T @ jacobian)
    return FilterFit(
        parameters,
        covariance,
        after,
        a,
        variance / count * np.linalg.inv(noise),
        innovations,
        variance,
        count,
    )


def burg(values: np.ndarray, lags: int) -> np.ndarray:
    """Coefficients a of n_k = sum a_i n_{k-i} + e_k by Burg's method; (lags,).

    Values are NaN between records, whose sums are added.
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
    """Values of so many samples before; of a negative number, after."""
    delayed = np.full(values.shape, np.nan)
    if by >= 0:
        delayed[by:] = values[: len(values) - by]
    else:
        delayed[:by] = values[-by:]
    return delayed


def _whitened(values: np.ndarray, lags: np.ndarray) -> np.ndarray:
    white = values.copy()
    for k, a in enumerate(lags, 1):
        white -= a * _delayed(values, k)
    return white
