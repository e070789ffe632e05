"""Covariance of winds in von Karman's turbulence, as it is and averaged as a sensor does.

The spectrum is a mixture of Gaussian eddies of many sizes. A Gaussian mean makes every eddy larger
and weaker, so that the covariance of averaged winds has a closed form.
"""

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma, roots_genlaguerre

COMPONENTS = ("u", "v", "w")
"""Of the wind, along x, y and z."""

Shape = Literal["gaussian", "falling"]
"""Of a mean: exp(-k^2 s^2/2) of a wave k, or (1 + k^2 s^2/2q)^-q, which falls as k^(-8/3)."""

# q of the second: a Wiener filter falls as the ratio of the inertial range in a plane to noise
_FALLING = 4 / 3
# Gaussians whose mixture it is; exact for 2 n - 1 moments of their variances.
_MIXED = 6
# a of the spectrum with the length scale of von Karman, 1.339 (Etkin 1972, chapter 13)
_A = gamma(1 / 3) / (np.sqrt(np.pi) * gamma(5 / 6))
_EXPONENT = 17 / 6
# Logarithms of the eddies' squares: the smallest are 1e-4 lengths and hold 0.2 % of the variance.
_SIZES = np.arange(-20.0, 3.6, 0.8)
# Squares over that of a mean below which eddies have no part in it: 1e-6 of their variance is left.
_LEAST = 1e-2


@lru_cache(maxsize=256)
def _eddies(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Squares of the eddies' sizes, m^2, and their weights in `covariance`.

    (1 + q^2)^-17/6 = integral over t of t^(11/6) exp(-t (1 + q^2)) dt / Gamma(17/6), with
    q = a L k; in steps of ln t the trapezoidal rule is exact to 1e-4.
    """
    t = np.exp(_SIZES)
    step = _SIZES[1] - _SIZES[0]
    weight = t**_EXPONENT * np.exp(-t) * step / gamma(_EXPONENT)
    scale = length * 55 / (36 * np.pi**2) * (_A * length) ** 4 * (2 * np.pi) ** 1.5
    return 2 * t * (_A * length) ** 2, scale * weight


class Mean(NamedTuple):
    """A mean in the plane of y and z as a mixture of Gaussians.

    variance, weight (gaussians,): of each, m^2 along each axis, and its fraction.
    """

    variance: np.ndarray
    weight: np.ndarray


POINT = Mean(np.zeros(1), np.ones(1))
"""No mean."""


@lru_cache(maxsize=256)
def mean_of(resolution: float, shape: Shape, times: int) -> Mean:
    """A mean that is taken once, or twice in a row: of one wind, or of both of a covariance.

    The second shape is a gamma mixture: (1 + a)^-q is the mean of exp(-t a) over t with the gamma
    distribution of shape q. ``resolution`` (m) is the standard deviation s.
    """
    if shape == "gaussian":
        return Mean(np.array([times * resolution**2]), np.ones(1))
    power = times * _FALLING
    nodes, weights = roots_genlaguerre(_MIXED, power - 1)
    return Mean(nodes * resolution**2 / _FALLING, weights / gamma(power))


def _averaged(length: float, mean: Mean, swept: float) -> tuple[np.ndarray, ...]:
    """Squares of the eddies' sizes along the path and in the plane, m^2, and weights.

    Without those that the mean removes.
    """
    sizes, weights = _eddies(length)
    large = sizes >= min(_LEAST * (mean.variance.min() + swept), sizes[-1])
    along = np.repeat(sizes[large] + swept, len(mean.weight))
    plane = np.add.outer(sizes[large] + swept, mean.variance).ravel()
    weights = np.outer(weights[large], mean.weight).ravel() / (np.sqrt(along) * plane)
    return along, plane, weights


def covariance(
    component: str,
    x: ArrayLike,
    y: ArrayLike,
    z: ArrayLike,
    length: float,
    mean: Mean = POINT,
    swept: float = 0.0,
) -> np.ndarray:
    """Covariance of one component of the wind at two places, over its variance.

    Turbulence is homogeneous, isotropic and without divergence: Phi_ii = E(k)/(4 pi k^4) (k^2 -
    k_i^2) with E(k) = L 55/(9 pi) (a L k)^4 / (1 + (a L k)^2)^(17/6) (von Karman 1948; Batchelor
    1953, The Theory of Homogeneous Turbulence, equation 3.4.12). Means over Gaussians of standard
    deviations s_1 and s_2 in the plane of y and z multiply the spectrum by exp(-k^2 (s_1^2 +
    s_2^2)/2) there.

    component {"u", "v", "w"}
    x, y, z: from one place to the other, m; broadcast.
    length: L, m.
    mean: of both winds together, see `mean_of`; default: they are not averaged.
    swept: variance along each axis of an unknown displacement of all air between both times, m^2.

    Returns
    -------
    ndarray
        1 at one place, without averages.
    """
    axis = COMPONENTS.index(component)
    along, plane, weights = _averaged(length, mean, swept)
    square = (along, plane, plane)
    places = [np.asarray(a, float)[..., None] for a in (x, y, z)]
    exponent = sum(a**2 / (2 * b) for a, b in zip(places, square, strict=True))
    # of the axes at right angles to the component: k^2 - k_i^2 in places
    curvature = sum(1 / square[n] - places[n] ** 2 / square[n] ** 2 for n in range(3) if n != axis)
    return (np.exp(-exponent) * curvature) @ weights


def lattice_covariance(
    component: str, y: np.ndarray, z: np.ndarray, length: float, mean: Mean, swept: float
) -> np.ndarray:
    """`covariance` of v or w at places of one plane with the nodes of a lattice in it.

    In time of the axes' lengths, not of their product: every eddy is a product. From the places to
    the nodes are y (n, ny) and z (n, nz), m; the covariance is (n, nz, ny).
    """
    along, plane, weights = _averaged(length, mean, swept)
    bells = [np.exp(-(a[..., None] ** 2) / (2 * plane)) for a in (y, z)]
    # the axis of the plane at right angles to the component
    number = 0 if component == "w" else 1
    curved = 1 / along + 1 / plane - (y, z)[number][..., None] ** 2 / plane**2
    bells[number] = bells[number] * curved * weights
    return bells[1] @ bells[0].swapaxes(1, 2)
