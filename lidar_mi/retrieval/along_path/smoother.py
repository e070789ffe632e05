"""One component of the wind along a path: Kalman's filter and smoother from slab to slab.

The field that the vectors are means of is known in a plane by its values at the nodes of a lattice,
whose principal components are the state. Along the path every one of them has an exponential
correlation, so that a recursive filter gives what the Gaussian process of all slabs at once gives
(Hartikainen and Särkkä 2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtri

from lidar_mi.retrieval.along_path.statistics import Statistics, error_correlation
from lidar_mi.retrieval.along_path.vectors import ACROSS, SlabVectors
from lidar_mi.retrieval.along_path.von_karman import (
    Mean,
    Shape,
    covariance,
    lattice_covariance,
    mean_of,
)

# Least variance of a principal component, over the largest.
_LEAST = 1e-6
# Variance of vectors without error, m^2/s^2.
_ROUNDING = 1e-12
# Fraction of turbulent slabs whose innovations are inflated by chance.
_CHANCE = 1e-3
# Times from slab to arrival are rounded to such steps, s.
_TIME_STEP = 0.5


@dataclass(frozen=True, eq=False)
class Basis:
    """Principal components of a component of the wind in a plane, for turbulence of variance 1.

    component {"v", "w"}
    length, resolution, shape: of `Statistics`.
    axes (two ndarrays, shapes (ny,) and (nz,)): y and z of the lattice's nodes, m.
    weights (nodes, states): from covariances with the nodes to values per state.
    variance, reach (states,): of each principal component, and its correlation length along the
        path, m.
    """

    component: str
    length: float
    resolution: float
    shape: Shape
    axes: tuple[np.ndarray, np.ndarray]
    weights: np.ndarray
    variance: np.ndarray
    reach: np.ndarray

    def mean(self, places: np.ndarray) -> np.ndarray:
        """Values per state (n, states) of a mean as a vector's at y and z (n, 2), m."""
        return self._with_nodes(places, mean_of(self.resolution, self.shape, 2), 0.0)

    def point(self, places: np.ndarray, swept: float) -> np.ndarray:
        """Values per state (n, states) of the wind at y and z (n, 2), m, itself.

        `swept` is the variance of the displacement since the slab was seen, m^2.
        """
        return self._with_nodes(places, mean_of(self.resolution, self.shape, 1), swept)

    def _with_nodes(self, places: np.ndarray, mean: Mean, swept: float) -> np.ndarray:
        y, z = (place[:, None] - axis for place, axis in zip(places.T, self.axes, strict=True))
        covariances = lattice_covariance(self.component, y, z, self.length, mean, swept)
        return covariances.reshape(len(places), -1) @ self.weights


@dataclass(frozen=True)
class Lattice:
    """Nodes in a plane about the path; as they are hashable, bases on them can be stored.

    ``half_width`` and ``half_height`` are the least reach of the nodes, (y, z) the place of one;
    all in m.
    """

    half_width: float
    half_height: float
    spacing: float
    y: float = 0.0
    z: float = 0.0

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """y and z of the nodes, m."""
        axes = []
        for half, start in ((self.half_width, self.y), (self.half_height, self.z)):
            count = np.ceil((half + abs(start)) / self.spacing)
            nodes = start + self.spacing * np.arange(-count, count + 1)
            # one node beyond the reach on either side
            axes.append(nodes[np.abs(nodes) < half + self.spacing])
        return axes[0], axes[1]

    def through(self, vectors: SlabVectors) -> "Lattice":
        """The lattice on the places of vectors, to a quarter of its spacing."""
        step = self.spacing / 4
        y, z = (
            float(np.rint(np.mod(axis[0], self.spacing) / step) * step) % self.spacing
            for axis in (vectors.y, vectors.z)
        )
        return replace(self, y=y, z=z)


@lru_cache(maxsize=64)
def basis(
    component: str, length: float, resolution: float, shape: Shape, stride: float, lattice: Lattice
) -> Basis:
    """The principal components on a lattice; each has its correlation over the `stride` (m)."""
    axes = lattice.axes
    y, z = (np.subtract.outer(a.ravel(), a.ravel()) for a in np.meshgrid(*axes))
    twice = mean_of(resolution, shape, 2)
    now, lagged = (covariance(component, lag, y, z, length, twice) for lag in (0.0, stride))
    variance, vectors = np.linalg.eigh(now)
    known = variance > _LEAST * variance[-1]
    variance, vectors = variance[known], vectors[:, known]
    decay = np.einsum("nm,nk,km->m", vectors, lagged, vectors) / variance
    reach = -stride / np.log(np.clip(decay, 1e-3, 1 - 1e-9))
    return Basis(component, length, resolution, shape, axes, vectors / variance, variance, reach)


@dataclass(frozen=True, eq=False)
class Observation:
    """How the vectors of a slab depend on the state, and their information on it.

    used (nz, ny): vectors over the lattice that are not rejected.
    gain (states, used): from the vectors to the information on the state, H' R^-1.
    information (states, states): H' R^-1 H.
    forward (used, states): H, from the state to the vectors.
    precision (used, used): R^-1, of the vectors' errors, (m/s)^-2.
    """

    used: np.ndarray
    gain: np.ndarray
    information: np.ndarray
    forward: np.ndarray
    precision: np.ndarray


def observation(
    basis: Basis, statistics: Statistics, vectors: SlabVectors, extra: np.ndarray | float = 0.0
) -> Observation:
    """Observation by the vectors over the lattice, with `extra` variance (nz, ny), m^2/s^2."""
    number = ACROSS.index(basis.component)
    y, z = np.meshgrid(vectors.y, vectors.z)
    reach = [np.abs(axis).max() + vectors.window / 4 for axis in basis.axes]
    used = vectors.valid & (np.abs(y) <= reach[0]) & (np.abs(z) <= reach[1])
    if not used.any():
        states = len(basis.variance)
        none = np.zeros((states, 0))
        return Observation(used, none, np.zeros((states, states)), none.T, np.zeros((0, 0)))
    places = np.stack([y[used], z[used]], -1)
    forward = _forward(basis, places.tobytes())
    stderr = statistics.scale * vectors.stderr[number][used]
    errors = stderr[:, None] * error_correlation(places, statistics.mean(2)) * stderr
    errors += vectors.common[number] ** 2
    arm = places[:, 1 - number] - vectors.centre[1 - number]
    errors += vectors.rotation**2 * np.outer(arm, arm)
    # variance that the states do not describe
    whole = float(covariance(basis.component, 0.0, 0.0, 0.0, basis.length, statistics.mean(2)))
    missing = np.maximum(whole - forward**2 @ basis.variance, 0.0)
    uncorrelated = statistics.sigma**2 * missing + np.broadcast_to(extra, used.shape)[used]
    # errors of 0 would make the covariance singular
    errors[np.diag_indices(len(errors))] += uncorrelated + _ROUNDING
    precision = cho_solve(cho_factor(errors), np.eye(len(errors)))
    gain = forward.T @ precision
    return Observation(used, gain, gain @ forward, forward, precision)


# on a straight path all slabs have their vectors at the same places
@lru_cache(maxsize=128)
def _forward(basis: Basis, places: bytes) -> np.ndarray:
    return basis.mean(np.frombuffer(places).reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class PathField:
    """A component of the wind along the path, as known from all slabs.

    x, time (slabs,): m, ascending, and s.
    mean (slabs, states)
    covariance (slabs, states, states)
    cross (slabs - 1, states, states): covariance of each slab's state with that of the next one.
    swept_speed: rms speed at which eddies are swept past a place, m/s.
    inflation (slabs,): factor of the variances about each slab, see `smoothed`.
    """

    basis: Basis
    statistics: Statistics
    x: np.ndarray
    time: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray
    swept_speed: float
    inflation: np.ndarray

    def at(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray, time: np.ndarray, *, error: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """The wind expected at places (n,), m, and times (n,), s, and its standard error, m/s.

        Between two slabs it depends on both, beyond the last ones it falls to zero with the
        correlation of the turbulence. Without `error` the standard error is zero.
        """
        right = np.clip(np.searchsorted(self.x, x), 1, max(1, len(self.x) - 1))
        left = right - 1 if len(self.x) > 1 else np.zeros_like(right)
        right = np.minimum(right, len(self.x) - 1)
        to_left, to_right = x - self.x[left], self.x[right] - x
        weight_left, weight_right = self._weights(to_left, to_right, right > left)
        state = weight_left * self.mean[left] + weight_right * self.mean[right]
        span = np.where(right > left, self.x[right] - self.x[left], 1.0)
        fraction = np.clip(to_left / span, 0.0, 1.0)
        slab_time = (1 - fraction) * self.time[left] + fraction * self.time[right]
        steps = np.rint(np.abs(time - slab_time) / _TIME_STEP).astype(int)
        # complex numbers are sorted ten times as fast as rows
        distinct, index = np.unique(y + 1j * z, return_inverse=True)
        places = np.stack([distinct.real, distinct.imag], -1)
        wind, stderr = np.zeros_like(x), np.zeros_like(x)
        for step in np.unique(steps):
            chosen = steps == step
            swept = (self.swept_speed * step * _TIME_STEP) ** 2
            value = self.basis.point(places, swept)[index[chosen]]
            wind[chosen] = (value * state[chosen]).sum(-1)
            if error:
                stderr[chosen] = self._stderr(
                    value, weight_left[chosen], weight_right[chosen], left[chosen], right[chosen],
                    to_left[chosen], to_right[chosen],
                )  # fmt: skip
        return wind, stderr

    def _weights(
        self, to_left: np.ndarray, to_right: np.ndarray, two: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weights of two slabs' states, (n, states): simple kriging, exponential correlation."""
        reach = self.basis.reach
        a, b = to_left[:, None] / reach, to_right[:, None] / reach
        inside = (two & (to_left > 0) & (to_right > 0))[:, None]
        # with one slab, or beyond both, the nearest counts
        nearer = np.where(two, to_left > 0, False)[:, None]
        with np.errstate(over="ignore", invalid="ignore"):
            scale = np.sinh(np.where(inside, a + b, 1.0))
            weight_left = np.where(
                inside, np.sinh(b) / scale, np.where(nearer, 0.0, np.exp(-np.abs(a)))
            )
            weight_right = np.where(
                inside, np.sinh(a) / scale, np.where(nearer, np.exp(-np.abs(b)), 0.0)
            )
        return weight_left, weight_right

    def _stderr(
        self,
        value: np.ndarray,
        weight_left: np.ndarray,
        weight_right: np.ndarray,
        left: np.ndarray,
        right: np.ndarray,
        to_left: np.ndarray,
        to_right: np.ndarray,
    ) -> np.ndarray:
        reach, sigma = self.basis.reach, self.statistics.sigma
        a, b = (np.exp(-np.abs(d)[:, None] / reach) for d in (to_left, to_right))
        # variance of the state given exact states of both slabs
        bridge = np.maximum(1 - weight_left * a - weight_right * b, 0.0) * self.basis.variance
        prior = (value**2 * self.basis.variance).sum(-1)
        variance = sigma**2 * (np.maximum(1 - prior, 0.0) + (value**2 * bridge).sum(-1))
        from_left, from_right = value * weight_left, value * weight_right
        pairs = ((from_left, left, from_left), (from_right, right, from_right))
        for first, slab, second in pairs:
            variance += np.einsum("nm,nmk,nk->n", first, self.covariance[slab], second)
        if len(self.cross):
            cross = self.cross[np.minimum(left, len(self.cross) - 1)]
            variance += 2 * np.einsum("nm,nmk,nk->n", from_left, cross, from_right)
        larger = np.maximum(self.inflation[left], self.inflation[right])
        return np.sqrt(larger * variance)


def smoothed(
    basis: Basis,
    statistics: Statistics,
    x: Sequence[float],
    time: Sequence[float],
    observations: Sequence[Observation],
    winds: Sequence[np.ndarray],
    swept_speed: float,
) -> PathField:
    """The field from the vectors of slabs: Kalman filter, and smoother of Rauch et al. 1965.

    ``x`` (m) ascends, with a ``time`` (s) each; ``winds`` (nz, ny) are the component of each slab's
    vectors (m/s).

    Notes
    -----
    Where the innovations of a slab and its neighbours are larger than in all but 1 of 1000
    turbulent slabs, variances there are multiplied by the mean square of the normalised
    innovations (Birge 1932): the air does not have these statistics, as in a vortex.
    """
    prior = statistics.sigma**2 * basis.variance
    decays = [np.exp(-step / basis.reach) for step in np.diff(x)]
    filtered, spreads, precisions = [], [], []
    state, spread = np.zeros(len(prior)), np.diag(prior)
    squares = np.zeros((2, len(observations)))  # of innovations, and how many
    for number, (observed, wind) in enumerate(zip(observations, winds, strict=True)):
        if number:
            decay = decays[number - 1]
            state = decay * state
            spread = decay[:, None] * spread * decay + np.diag(prior * (1 - decay**2))
        precision = np.linalg.inv(spread)
        spread = np.linalg.inv(precision + observed.information)
        innovation = wind[observed.used] - observed.forward @ state
        change = observed.gain @ innovation
        # i' (H P H' + R)^-1 i
        square = innovation @ observed.precision @ innovation - change @ spread @ change
        squares[:, number] = square, len(innovation)
        state = state + spread @ change
        filtered.append(state)
        spreads.append(spread)
        precisions.append(precision)
    mean, after = np.array(filtered), np.array(spreads)
    cross = np.zeros((len(filtered) - 1, len(prior), len(prior)))
    for number in range(len(filtered) - 2, -1, -1):
        decay, later = decays[number], number + 1
        gain = (spreads[number] * decay) @ precisions[later]
        mean[number] += gain @ (mean[later] - decay * filtered[number])
        cross[number] = gain @ after[later]
        # P + G (P_s - P_p) G', with the predicted covariance P_p and the gain G = P D P_p^-1
        after[number] += cross[number] @ gain.T - gain @ (decay[:, None] * spreads[number])
    return PathField(
        basis,
        statistics,
        np.asarray(x, float),
        np.asarray(time, float),
        mean,
        after,
        cross,
        swept_speed,
        _inflation(*squares),
    )


def _inflation(square: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Mean square of each slab and its neighbours where it is significant, else 1."""
    three = np.ones(3)
    total, freedom = (np.convolve(a, three)[1:-1] for a in (square, number))
    freedom = np.maximum(freedom, 1.0)
    return np.where(total > chdtri(freedom, _CHANCE), total / freedom, 1.0)
