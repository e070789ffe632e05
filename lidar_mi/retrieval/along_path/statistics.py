"""Statistics of turbulence from vectors: its strength and size, and what the vectors resolve."""

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product

import numpy as np
from scipy.fft import dctn

from lidar_mi.retrieval.along_path.vectors import ACROSS, SlabVectors
from lidar_mi.retrieval.along_path.von_karman import Mean, Shape, covariance, mean_of

LENGTHS = tuple(15.0 * 2.0 ** np.arange(7))
"""Lengths of turbulence that are compared, m: from a wind turbine's wake to cruise."""

RESOLUTIONS = (0.29, 0.4, 0.55, 0.75, 1.0, 1.4, 2.0)
"""Standard deviations of the mean in a vector, in windows. That of a box is 1/sqrt(12) = 0.29."""

MEANS: tuple[tuple[Shape, float], ...] = (
    *(("gaussian", part) for part in RESOLUTIONS),
    *(("falling", part) for part in RESOLUTIONS[2:]),
)
"""Shapes and standard deviations of the means that are compared."""

RATIOS = np.geomspace(0.01, 100.0, 36)
"""True errors of the vectors over the rms of turbulence, in units of stated errors of 1 m/s."""

_SHAPE = (len(LENGTHS), len(MEANS), len(RATIOS))
# Prior: stated errors are known to a factor of 2.
_KNOWN_TO = np.log(2.0)
# Slabs over which statistics are remembered: turbulence changes with height.
_MEMORY = 80
_BANDS = 10
# Least rms of turbulence, m/s.
_LEAST = 1e-3
# Fraction of an error's variance that is not correlated with the neighbours'.
_WHITE = 0.03


@dataclass(frozen=True)
class Statistics:
    """Statistics of the air and of the vectors before a slab is observed.

    sigma, length: rms of a component (m/s) and length (m) of von Karman's turbulence.
    resolution: standard deviation of the mean that a vector is, m.
    scale: true over stated errors of the vectors.
    shape {"gaussian", "falling"}: of the mean.
    """

    sigma: float
    length: float
    resolution: float
    scale: float = 1.0
    shape: Shape = "gaussian"

    def mean(self, times: int) -> Mean:
        """The mean that a vector is, taken once or twice."""
        return mean_of(self.resolution, self.shape, times)


def noise_correlation(square: np.ndarray, twice: Mean) -> np.ndarray:
    """Correlation of averaged white noise at squared distances, m^2; `twice` is the mean's square.

    A Gaussian mean of standard deviation s makes it exp(-r^2/(4 s^2)).
    """
    weight = twice.weight / twice.variance
    return np.exp(-square[..., None] / (2 * twice.variance)) @ weight / weight.sum()


def error_correlation(places: np.ndarray, twice: Mean) -> np.ndarray:
    """Correlation of the errors of vectors at places (n, 2), in m: (n, n)."""
    smooth = noise_correlation(((places[:, None] - places) ** 2).sum(-1), twice)
    return (1 - _WHITE) * smooth + _WHITE * np.eye(len(places))


@dataclass(frozen=True, eq=False)
class _Expected:
    """Mean squares of the cosines of a grid, by band: of turbulence of variance 1, of errors of 1.

    Shapes (lengths, means, 2, bands) of a slab and of two successive ones, (means, bands)
    of the errors; `band` (nz, ny) numbers the bands.
    """

    turbulence: np.ndarray
    lagged: np.ndarray
    errors: np.ndarray
    band: np.ndarray


@lru_cache(maxsize=16)
def _expected(shape: tuple[int, int], window: float, stride: float) -> _Expected:
    nz, ny = shape
    waves = np.hypot(*np.meshgrid(np.arange(nz) / nz, np.arange(ny) / ny, indexing="ij"))
    # bands of equally many cosines; the mean has one of its own
    order = waves.ravel().argsort().argsort().reshape(shape)
    size = max(1.0, (nz * ny - 1) / (_BANDS - 1))
    band = np.where(order == 0, 0, 1 + ((order - 1) / size).astype(int))
    counts = np.bincount(band.ravel())
    lag_z, lag_y = (window * np.arange(1 - n, n) for n in shape)
    index = [np.subtract.outer(np.arange(n), np.arange(n)) + n - 1 for n in shape]

    def squares(of_lags: np.ndarray) -> np.ndarray:
        """Mean squares by band of a field with covariances at all lags."""
        full = of_lags[index[0][:, None, :, None], index[1][None, :, None, :]]
        once = dctn(full, axes=(0, 1), norm="ortho")
        twice = dctn(once, axes=(2, 3), norm="ortho")
        variance = np.einsum("zyzy->zy", twice)
        return np.bincount(band.ravel(), variance.ravel()) / counts

    now, lagged = np.zeros((2, len(LENGTHS), len(MEANS), len(ACROSS), len(counts)))
    twice = [mean_of(part * window, kind, 2) for kind, part in MEANS]
    for (i, length), (j, across), (k, name) in product(
        enumerate(LENGTHS), enumerate(twice), enumerate(ACROSS)
    ):
        now[i, j, k] = squares(covariance(name, 0.0, lag_y, lag_z[:, None], length, across))
        lagged[i, j, k] = squares(covariance(name, stride, lag_y, lag_z[:, None], length, across))
    square = lag_z[:, None] ** 2 + lag_y**2
    errors = np.array([squares(noise_correlation(square, mean)) for mean in twice])
    return _Expected(now, lagged, errors, band)


@dataclass(eq=False)
class StatisticsEstimator:
    """Learns `Statistics` from slab to slab, a stride (m) apart, by their likelihood.

    Cosines of a slab are nearly independent (Whittle 1954), and each depends on the same cosine of
    the slab before (Vecchia 1988, J. R. Stat. Soc. B 50): the likelihood is that of the Gaussian
    conditional distributions, for every combination of `LENGTHS`, `MEANS` and `RATIOS`, each with
    the variance that is most likely. All have the same prior, except for the scale of the errors;
    the most probable one is taken.
    """

    stride: float
    _sums: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    _window: float = 0.0
    _last: tuple[float, np.ndarray] | None = None
    _sigma: np.ndarray = field(default_factory=lambda: np.ones(_SHAPE))

    def add(self, x: float, vectors: SlabVectors) -> None:
        """Add a slab at x (m); one with many rejected vectors is not used."""
        valid = vectors.valid
        last, self._last = self._last, None
        if min(valid.shape) < 3 or valid.mean() < 0.7:
            return
        self._window = vectors.window
        wind = np.where(valid, vectors.wind, vectors.wind[:, valid].mean(1)[:, None, None])
        waves = dctn(wind, axes=(1, 2), norm="ortho")
        band = self._expected(valid.shape).band.ravel()
        error = np.mean(vectors.stderr[:, valid] ** 2, 1)
        common = vectors.common**2 * valid.size
        # a floor of white noise, as a vector is only nearly a Gaussian mean
        white = _WHITE * error[:, None, None]
        self._last = x, waves
        for sums in self._sums.values():
            sums *= 1 - 1 / _MEMORY
        follows = last is not None and abs(x - last[0] - self.stride) < 0.3 * self.stride
        if last is not None and follows and last[1].shape == waves.shape:
            products = (waves**2 + white, waves * last[1], last[1] ** 2 + white)
        else:
            # no slab before it
            products = (waves**2 + white, np.zeros_like(waves), np.zeros_like(waves))
            follows = False
        sums = self._sums.setdefault(valid.shape, np.zeros((2, 6, len(ACROSS), band.max() + 1)))
        part = sums[int(follows)]
        for n, square in enumerate(products):
            part[n] += [np.bincount(band, a.ravel()) for a in square]
        part[3] += np.bincount(band)
        part[4] += error[:, None] * np.bincount(band)
        # errors of pointing shift the mean of all vectors
        part[5, :, 0] += common

    def _expected(self, shape: tuple[int, int]) -> _Expected:
        return _expected(shape, round(self._window, 6), round(self.stride, 6))

    @property
    def statistics(self) -> Statistics | None:
        """The most probable statistics; None before the first slab."""
        if not self._sums:
            return None
        number, logarithm, square = 0.0, np.zeros(_SHAPE), np.zeros(_SHAPE)
        for shape, sums in self._sums.items():
            expected = self._expected(shape)
            for follows, part in enumerate(sums):
                if part[3].any():
                    more = _likelihood(expected, part, bool(follows), self._sigma)
                    number += float(part[3].sum())
                    logarithm += more[0]
                    square += more[1]
        # the most probable common variance is the mean square
        sigma = np.sqrt(np.maximum(square / number, _LEAST**2))
        self._sigma = sigma
        cost = logarithm + 2 * number * np.log(sigma) + square / sigma**2
        scale = np.maximum(RATIOS * sigma, 1e-9)
        cost += (np.log(scale) / _KNOWN_TO) ** 2
        i, j, k = np.unravel_index(int(cost.argmin()), cost.shape)
        kind, part = MEANS[j]
        return Statistics(
            sigma=float(sigma[i, j, k]),
            length=float(LENGTHS[i]),
            resolution=part * self._window,
            scale=float(scale[i, j, k]),
            shape=kind,
        )


def _likelihood(
    expected: _Expected, sums: np.ndarray, follows: bool, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the variances, and squares over them, of turbulence of variance 1.

    Dims of `_SHAPE`. Known errors are divided by the last estimate of `sigma` (m/s).
    """
    now, product, before, count, error, common = sums
    number = np.maximum(count, 1e-9)
    noise = RATIOS[:, None, None] ** 2 * expected.errors[:, None, None, :] * (error / number)
    known = (common + _WHITE * error) / number / sigma[..., None, None] ** 2
    variance = expected.turbulence[:, :, None] + noise + known
    if not follows:
        return (count * np.log(variance)).sum((-2, -1)), (now / variance).sum((-2, -1))
    gain = expected.lagged[:, :, None] / variance
    remaining = variance * (1 - gain**2)
    square = now - 2 * gain * product + gain**2 * before
    return (count * np.log(remaining)).sum((-2, -1)), (square / remaining).sum((-2, -1))
