"""Covariance of the wind of isotropic turbulence between places."""

import functools
import math

import numpy as np
import scipy

LENGTH_TO_SCALE = 1.339
"""Constant a of von Karman's spectrum: sqrt(pi) Gamma(5/6) / Gamma(1/3), rounded."""

_NODES = np.concatenate([[0.0], np.geomspace(1e-6, 40.0, 2000)])


def correlations(distance: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Longitudinal and lateral correlation of von Karman's turbulence, f(r) and g(r).

    f = 2^(2/3) / Gamma(1/3) q^(1/3) K_1/3(q), g = f + r f' / 2 with q = r / (a L), for turbulence
    without divergence (von Karman, Proc. Natl. Acad. Sci. 34, 530-539, 1948; Batchelor, The Theory
    of Homogeneous Turbulence, 1953, eq. 3.4.6). L is the integral scale along the wind, m.
    """
    along, across = _table()
    q = np.minimum(distance / (LENGTH_TO_SCALE * length), _NODES[-1])
    return np.interp(q, _NODES, along), np.interp(q, _NODES, across)


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    q = _NODES[1:]
    factor = 2 ** (2 / 3) / math.gamma(1 / 3) * np.cbrt(q)
    along = factor * scipy.special.kv(1 / 3, q)
    # f' = -factor K_2/3, as the derivative of q^n K_n is -q^n K_(n-1)
    across = along - q / 2 * factor * scipy.special.kv(2 / 3, q)
    unity = np.ones(1)
    return np.concatenate([unity, along]), np.concatenate([unity, across])


def _parts(
    first: np.ndarray, last: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lateral correlation, longitudinal less lateral, and unit vectors between places."""
    offset = first[:, None] - last[None]
    distance = np.linalg.norm(offset, axis=-1)
    along, across = correlations(distance, length)
    return across, along - across, offset / np.where(distance > 0, distance, 1.0)[..., None]


def of_lines(places: np.ndarray, directions: np.ndarray, length: float) -> np.ndarray:
    """Covariance (n, n) of the wind along n directions at n places, of unit variance a component.

    Places are in m, as is the length of `correlations`; directions are unit vectors.
    """
    across, more, unit = _parts(places, places, length)
    radial = np.einsum("ia,ija->ij", directions, unit)
    return across * (directions @ directions.T) + more * radial * np.einsum(
        "ja,ija->ij", directions, unit
    )


def with_average(
    path: np.ndarray, places: np.ndarray, directions: np.ndarray, length: float
) -> np.ndarray:
    """Covariance (n, 3) of the wind along directions with its average over a path (m, 3)."""
    across, more, unit = _parts(path, places, length)
    radial = more * np.einsum("ija,ja->ij", unit, directions)
    return across.mean(0)[:, None] * directions + np.einsum("ij,ija->ja", radial, unit) / len(path)


def of_average(path: np.ndarray, length: float) -> np.ndarray:
    """Covariance (3, 3) of the average wind over a path (m, 3)."""
    across, more, unit = _parts(path, path, length)
    return across.mean() * np.eye(3) + np.einsum("ij,ija,ijb->ab", more, unit, unit) / more.size
