"""What resampling scattered beams adds to an image's error: from the image's own variogram."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.ndimage import maximum_filter, uniform_filter
from scipy.optimize import least_squares, nnls
from scipy.spatial import KDTree

from lidar_mi.flags import Flag

# Neighbours of a beam whose differences make the variogram, and bins along distance and time.
_NEIGHBOURS, _BINS = 12, 12
# Beams over which the structure's strength is averaged at a place, and bins of the noise.
_LOCAL, _NOISE_BINS = 75, 24
# Mean square of what resampling lost over that of the noise, of a vector that is not flagged.
_LOST = 4.0
# Fraction of the vectors beyond which all are flagged.
_MOST = 2 / 3
# Nearest beams that their density is from.
_AREA = 12
# Length of the structure for which beams are weighted, in spacings.
_LENGTH = 1.5
# Exponent a: of lengths that differ much, and of nearly one.
_MANY, _ONE = 1.0, 20.0


class Variogram(NamedTuple):
    """Half the mean squared difference of two beams, c (1 - (1 + d^2 / (2 a l^2))^-a), no noise.

    d^2 = h^2 + (s tau)^2, h in spacings and tau in s between the beams: air that passes with the
    speed s, in spacings a second. A mixture of Gaussians of many lengths (Rasmussen & Williams
    2006, Gaussian Processes for Machine Learning, eq. 4.19), smooth at the scale of a beam, which
    has blurred the air.
    """

    strength: float
    length: float
    exponent: float
    speed: float
    noise: float

    def __call__(self, separation: np.ndarray, delay: np.ndarray) -> np.ndarray:
        """Of the structure, for distances (..., 2) in spacings and times (...), s."""
        square = (separation**2).sum(-1) + (self.speed * delay) ** 2
        a = self.exponent
        # 1 - (1 + x)^-a, exact also next to 0
        return self.strength * -np.expm1(-a * np.log1p(square / (2 * a * self.length**2)))


class Pairs(NamedTuple):
    """Beams next to each other: distances (n, k, 2) in spacings, times (n, k), indices (n, k)."""

    separation: np.ndarray
    delay: np.ndarray
    near: np.ndarray


def pairs(places: np.ndarray, times: np.ndarray) -> Pairs:
    """Pairs of every beam with its nearest ones; places (n, 2) in spacings, times (n,) in s."""
    _, near = KDTree(places).query(places, min(_NEIGHBOURS + 1, len(places)))
    near = near[:, 1:]
    return Pairs(places[near] - places[:, None], times[near] - times[:, None], near)


def variogram(values: np.ndarray, near: Pairs) -> Variogram:
    """The variogram that fits the differences of neighbouring beams best (Cressie 1985).

    Bins of distance and time count by their number of pairs over the square of the model (Cressie
    1985, Math. Geol. 17, 563-586). The rest is the noise.
    """
    half = ((values[near.near] - values[:, None]) ** 2 / 2).ravel()
    distance, delay = np.linalg.norm(near.separation, axis=-1).ravel(), np.abs(near.delay).ravel()
    edges = [
        np.unique(np.quantile(part, np.linspace(0, 1, _BINS + 1))) for part in (distance, delay)
    ]
    cell = [
        np.searchsorted(e[1:-1], p, "right") for e, p in zip(edges, (distance, delay), strict=True)
    ]
    index = cell[0] * (_BINS + 1) + cell[1]
    number = np.bincount(index)
    h, tau, observed = (
        np.bincount(index, part)[number > 0] / number[number > 0]
        for part in (distance, delay, half)
    )
    number, scale = number[number > 0], max(float(half.mean()), 1e-300)
    fastest = np.ptp(distance) / max(float(delay.max()), 1e-9)

    def model(p: np.ndarray) -> Variogram:
        return Variogram(np.exp(p[0]) * scale, np.exp(p[1]), p[2], p[3] * fastest, p[4] * scale)

    def misfit(p: np.ndarray) -> np.ndarray:
        made = model(p)
        expected = made(np.stack([h, 0 * h], -1), tau) + made.noise
        # relative: squared differences scatter in proportion to their mean
        return np.sqrt(number) * (observed / expected - 1)

    start = np.array([1.0, np.log(3.0), 2.0, 1.0, 0.05])
    low = np.array([-4.0, np.log(0.7), _MANY, 0.0, 1e-6])
    high = np.array([6.0, np.log(30.0), _ONE, 20.0, 1.5])
    return model(least_squares(misfit, start, bounds=(low, high), loss="soft_l1").x)


def flag_resampled(wind: xr.Dataset, noise: xr.DataArray, with_it: xr.DataArray) -> xr.Dataset:
    """The wind with vectors flagged where resampling lost more than stated errors can hold.

    The loss depends on the air and on the fixed places of the beams: it is a bias as well as noise.
    Flagged are vectors with a place at most half a template away, over whose template its mean
    square exceeds 4 times that of the noise: a smooth field carries the bias to its neighbours. If
    only places over the template counted, errors in the interior of Lissajous figures would be 1.5
    to 1.7 times as large as stated. All vectors are flagged where two thirds of those that have a
    displacement are: the others' errors are then up to 2.6 times as large as stated.

    wind: from `retrieve_wind`, with `template` among its attributes.
    noise, with_it (z, y): noise of an image, and the same with what resampling adds.
    """
    template = int(wind.attrs["template"])
    square = [field.fillna(0.0).transpose("z", "y").values ** 2 for field in (noise, with_it)]
    known, both = (uniform_filter(part.astype(float), template) for part in square)
    lost = maximum_filter((both > (1 + _LOST) * known).astype(float), template + 1)
    lost = noise.copy(data=lost)
    at = {axis: wind[axis] for axis in ("z", "y")}
    bad = lost.interp(at, method="nearest").transpose(*wind["flag"].dims).values > 0.5
    flag = wind["flag"]
    displaced = np.isfinite(wind["v"].transpose(*flag.dims).values)
    bad |= bool(displaced.any()) and bad[displaced].mean() > _MOST
    flags = flag.values | np.where(bad, Flag.RESAMPLED.value, 0)
    return wind.assign(flag=flag.copy(data=flags.astype(flag.dtype)))


class LeaveOneOut(NamedTuple):
    """Beams estimated from their neighbours.

    Places (n, 2), squared errors without noise (n,), their expectation for `structure` of strength
    1 (n,); mean noise of a beam and mean strength.
    """

    places: np.ndarray
    square: np.ndarray
    expected: np.ndarray
    noise: float
    strength: float


def structure(speed: float) -> Variogram:
    """Variogram of strength 1 and the length for which beams are weighted."""
    return Variogram(1.0, _LENGTH, 1.0, speed, 0.0)


def leave_one_out(
    places: np.ndarray, square: np.ndarray, expected: np.ndarray, noisy: np.ndarray
) -> LeaveOneOut:
    """Beams with the noise that explains their squared errors, together with the structure.

    The error of a beam estimated from its neighbours is due to the structure between them and to
    the noise of all, ``noisy`` times that of one. Both are fitted, not below 0, to means over bins
    of the structure's part: of close beams only the noise remains.
    """
    edges = np.quantile(expected, np.linspace(0, 1, _NOISE_BINS + 1)[1:-1])
    index = np.searchsorted(edges, expected)
    number = np.bincount(index)
    means = [np.bincount(index, part) for part in (square, noisy, expected)]
    observed, by_noise, by_air = (part[number > 0] / number[number > 0] for part in means)
    observed = np.maximum(observed, 1e-300)
    # relative to the observed: bins of close beams, which show the noise, weigh as much as others
    matrix = np.stack([by_noise / observed, by_air / observed], 1)
    scale = np.maximum(matrix.max(0), 1e-300)
    (noise, strength), _ = nnls(matrix / scale, np.ones(len(observed)))
    noise, strength = noise / scale[0], strength / scale[1]
    return LeaveOneOut(places, square - noise * noisy, expected, float(noise), float(strength))


def strength_at(errors: LeaveOneOut, nodes: np.ndarray) -> np.ndarray:
    """The structure's strength about nodes (m,), at least a hundredth of the mean."""
    _, near = KDTree(errors.places).query(nodes, min(_LOCAL, len(errors.places)))
    above, below = errors.square[near].mean(-1), errors.expected[near].mean(-1)
    return np.maximum(above / np.maximum(below, 1e-300), 0.01 * errors.strength)


def correlation_area(places: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Pixels per independent error about nodes (m,): an error for 1.5 beams, at least 1.5.

    Errors of neighbouring nodes are from the same beams. Sums of them over 7 px vary as those of
    one error for 1 to 2 beams do, by the texture.
    """
    count = min(_AREA, len(places))
    distance, _ = KDTree(places).query(nodes, [count])
    return 1.5 * np.clip(np.pi * distance[:, 0] ** 2 / count, 1.0, None)


def variance(
    structure: Variogram, weights: np.ndarray, from_node: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Mean squared error of weighted beams for the structure at a node, (m,).

    2 sum w_i g(x_i - x) - sum w_i w_j g(x_i - x_j), g the variogram, for weights (m, k) of sum 1
    (Cressie 1993, eq. 3.2.6), whether or not they are the best for it; from_node (m, k, 2).
    Times (m, k) are relative to the node's, which is their weighted mean.
    """
    to_node = 2 * (weights * structure(from_node, times)).sum(-1)
    separation = from_node[:, :, None] - from_node[:, None]
    delay = times[:, :, None] - times[:, None]
    among = np.einsum("mi,mij,mj->m", weights, structure(separation, delay), weights)
    return np.clip(to_node - among, 0.0, None)
