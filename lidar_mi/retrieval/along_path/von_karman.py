"""Covariance of winds in von Karman's turbulence, as it is and averaged as a sensor does.

The spectrum is a mixture of Gaussian eddies of many sizes. A Gaussian mean makes every eddy larger
and weaker, so that the covariance of averaged winds has a closed form.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma

COMPONENTS = ("u", "v", "w")
"""Of the wind, along x, y and z."""

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


def _larger(length: float, mean: float) -> tuple[np.ndarray, np.ndarray]:
    """The eddies that a mean, of so much variance in m^2, leaves."""
    sizes, weights = _eddies(length)
    some = sizes >= min(_LEAST * mean, sizes[-1])
    return sizes[some], weights[some]


def covariance(
    component: str,
    x: ArrayLike,
    y: ArrayLike,
    z: ArrayLike,
    length: float,
    across: float = 0.0,
    swept: float = 0.0,
) -> np.ndarray:
    """Covariance of one component of the wind at two places, over its variance.

    Turbulence is homogeneous, isotropic and without divergence: Phi_ii = E(k)/(4 pi k^4) (k^2 -
    k_i^2) with E(k) = L 55/(9 pi) (a L k)^4 / (1 + (a L k)^2)^(17/6) (von Karman 1948; Batchelor
    1953, The Theory of Homogeneous Turbulence, equation 3.4.12). Means over Gaussians of standard
    deviations s_1 and s_2 in the plane of y and z multiply the spectrum by exp(-k^2 (s_1^2 +
    s_2^2)/2) there.

    Parameters
    ----------
    component : {"u", "v", "w"}
    x, y, z : array_like
        From one place to the other, m; broadcast.
    length : float
        L, m.
    across : float
        s_1^2 + s_2^2, m^2: 0 of winds that are not averaged, s^2 of one that is and one that is
        not.
    swept : float
        Variance along each axis of an unknown displacement of all air between both times, m^2.

    Returns
    -------
    ndarray
        1 at one place, without averages.
    """
    axis = COMPONENTS.index(component)
    sizes, weights = _larger(length, across + swept)
    square = (sizes + swept, sizes + swept + across, sizes + swept + across)
    places = [np.asarray(a, float)[..., None] for a in (x, y, z)]
    exponent = sum(a**2 / (2 * b) for a, b in zip(places, square, strict=True))
    # of the axes at right angles to the component: k^2 - k_i^2 in places
    curvature = sum(1 / square[n] - places[n] ** 2 / square[n] ** 2 for n in range(3) if n != axis)
    weights = weights / np.sqrt(square[0] * square[1] * square[2])
    return (np.exp(-exponent) * curvature) @ weights


def lattice_covariance(
    component: str, y: np.ndarray, z: np.ndarray, length: float, across: float, swept: float
) -> np.ndarray:
    """`covariance` of v or w at places of one plane with the nodes of a lattice in it.

    In time of the axes' lengths, not of their product: every eddy is a product.

    Parameters
    ----------
    component : {"v", "w"}
    y, z : ndarray, shapes (n, ny) and (n, nz)
        From the places to the nodes, m.
    length, across, swept
        As in `covariance`.

    Returns
    -------
    ndarray, shape (n, nz, ny)
    """
    sizes, weights = _larger(length, across + swept)
    along, plane = sizes + swept, sizes + swept + across
    weights = weights / (np.sqrt(along) * plane)
    bells = [np.exp(-(a[..., None] ** 2) / (2 * plane)) for a in (y, z)]
    # the axis of the plane at right angles to the component
    number = 0 if component == "w" else 1
    curved = 1 / along + 1 / plane - (y, z)[number][..., None] ** 2 / plane**2
    bells[number] = bells[number] * curved * weights
    return bells[1] @ bells[0].swapaxes(1, 2)
