"""Whether a scan shows a wake, how probably by chance, and where."""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.ground_vortices.fit import Air, Assumptions
from lidar_mi.retrieval.ground_vortices.scan_plane import PlaneScan
from lidar_mi.retrieval.ground_vortices.swirl import lines_of, radial_velocity
from lidar_mi.retrieval.ground_vortices.turbulence import of_gates, overlap

SEPARATIONS = (22.0, 32.0, 46.0, 64.0)
"""Of the pairs that are searched for, m: factors of about 1.4, of spans of 28 to 81 m."""

TYPICAL = 300.0
"""Circulation of a wake before the scan: standard deviation of a half-normal number, m^2/s."""

LENGTHS = (50.0, 200.0)
"""Length scales of turbulence that are considered, m."""

_CELL = 6.0  # m, height of the cells
_ROWS = 15  # of a window: 90 m
_WIDTH = 75.0  # m, half of a window along the lines
_ANGLES = np.deg2rad(6.0)  # classes of elevations that share a filter
_SIGMAS = np.geomspace(0.02, 3.0, 16)  # m/s, strengths of turbulence that are compared
_LEAST = 0.6  # fraction of a window's cells with values
_MOST_PATTERNS = 150
_STARTS = 3  # candidates that are kept, by so many m from each other and from the best
_APART, _NEAR = 10.0, 50.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """Vortices (n, 4) at a maximum of a filter, and its normalised amplitude."""

    vortices: np.ndarray
    score: float


@dataclass(frozen=True, eq=False)
class Detection:
    """Result of the matched filters of a scan.

    score: largest normalised amplitude of all filters at all places.
    false_alarm: probability of such a score somewhere in a scan of turbulence and noise without a
        wake.
    probability: of a wake, if before the scan it is 1/2 and every place is equally likely.
    candidates: starts of a fit, best first.
    air: turbulence, from the windows' median.
    """

    score: float
    false_alarm: float
    probability: float
    candidates: list[Candidate]
    air: Air


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows around places of a scan, of cells in rows across the lines.

    offsets (columns,): of the gates from the middle, m.
    values, usable (windows, cells)
    centre, angle (windows,): of the middle, m and rad.
    noise (windows,): mean variance of a cell, (m/s)^2.
    """

    offsets: np.ndarray
    values: np.ndarray
    usable: np.ndarray
    centre: np.ndarray
    angle: np.ndarray
    noise: np.ndarray


def detect(
    scan: PlaneScan,
    lidar: CoherentLidar,
    assumed: Assumptions,
    *,
    separations: tuple[float, ...] = SEPARATIONS,
    single: bool = False,
) -> Detection:
    """Matched filters of pairs of several separations, or of one vortex, all over a scan.

    A window around a place has the mean wind as a polynomial of second degree in height, turbulence
    and noise. The filter is the likelihood ratio of a level pair of unknown circulation against
    them.
    """
    windows = _windows(scan, lidar)
    if windows is None:
        return Detection(-np.inf, 1.0, 0.0, [], Air(0.3, LENGTHS[0]))
    air = _air(windows, lidar)
    z, information = _scores(windows, air, lidar, assumed, separations, single)
    signs = np.abs(z) if single else z
    # turbulence that is stronger than in most windows, or of another length, spreads all scores
    spread = np.maximum(1.0, 1.4826 * np.median(np.abs(z), axis=1, keepdims=True))
    score = float((signs / spread).max())
    # the ratio of likelihoods of each place, over a half-normal circulation
    strength = TYPICAL**2 * information
    gain = strength / (1 + strength)
    level = z / spread
    ratio = 0.5 * gain * level**2 - 0.5 * np.log1p(strength)
    if not single:
        ratio = ratio + math.log(2) + scipy.special.log_ndtr(level * np.sqrt(gain))
    total = scipy.special.logsumexp(ratio) - math.log(ratio.size)
    return Detection(
        score,
        _chance(windows, level, score, 2 if single else 1),
        float(scipy.special.expit(total)),
        _candidates(windows, signs, z, information, separations, single, assumed),
        air,
    )


def _windows(scan: PlaneScan, lidar: CoherentLidar) -> _Windows | None:
    step = float(np.median(np.diff(scan.ranges)))
    thin = max(1, int(np.floor(0.5 * lidar.gate_length / step + 0.01)))
    gates = np.arange(0, scan.ranges.size, thin)
    half = max(1, round(_WIDTH / (step * thin)))
    usable = np.isfinite(scan.velocity)
    parts = np.where(usable, scan.velocity, 0.0), np.where(usable, scan.variance, 0.0), usable
    windows: list[tuple[np.ndarray, ...]] = []
    for middle in range(half // 2, len(gates) - half // 2):
        index = np.arange(middle - half, middle + half + 1)
        inside = (index >= 0) & (index < len(gates))
        columns = gates[index[inside]]
        centre = scan.ranges[gates[middle]]
        bins = np.floor((scan.angle - scan.angle[0]) / (_CELL / centre)).astype(int)
        starts = np.flatnonzero(np.diff(bins, prepend=-1))
        rows, pad = int(bins[-1]) + 1, _ROWS // 2
        total = np.zeros((3, rows + 2 * pad, index.size))
        at = np.ix_(np.arange(3), bins[starts] + pad, np.flatnonzero(inside))
        total[at] = [np.add.reduceat(part[:, columns], starts, axis=0) for part in parts]
        count = np.maximum(total[2], 1)
        cells = np.stack([total[0] / count, total[1] / count**2, total[2] > 0])
        view = np.lib.stride_tricks.sliding_window_view(cells, _ROWS, 1)
        values, noise, known = view.transpose(0, 1, 3, 2).reshape(3, rows, -1)
        enough = known.mean(1) >= _LEAST
        angle = scan.angle[0] + (np.arange(rows) + 0.5) * (_CELL / centre)
        mean = noise.sum(1) / np.maximum(known.sum(1), 1)
        arrays = values, known > 0, np.full(rows, centre), angle, mean
        windows.append(tuple(array[enough] for array in arrays))
    if not any(values.size for values, *_ in windows):
        return None
    offsets = np.arange(-half, half + 1) * step * thin
    return _Windows(offsets, *(np.concatenate(part) for part in zip(*windows, strict=True)))


def _geometry(windows: _Windows) -> tuple[np.ndarray, np.ndarray]:
    """Distances (cells,) of the cells from the middle, along the lines and across them, m."""
    across = (np.arange(_ROWS) - _ROWS // 2) * _CELL
    along, height = np.broadcast_arrays(windows.offsets, across[:, None])
    return along.ravel(), height.ravel()


@dataclass(frozen=True, eq=False)
class _Contrasts:
    """Contrasts that a mean wind does not change, independent in any turbulence and noise.

    ``basis`` (cells, numbers) makes them of the cells; turbulence of unit variance gives them the
    variances ``turbulent``, noise of unit variance 1 each.
    """

    basis: np.ndarray
    turbulent: np.ndarray


def _contrasts(
    windows: _Windows, lidar: CoherentLidar, length: float, known: np.ndarray
) -> _Contrasts:
    along, height = _geometry(windows)
    along, height = along[known], height[known]
    full = of_gates(along[:, None] - along, height[:, None] - height, lidar, (length,), _CELL)[0]
    shared = overlap(along, lidar.gate_length) * (np.abs(height[:, None] - height) < _CELL / 2)
    scaled = height / (_ROWS * _CELL / 2)
    mean = np.stack([np.ones_like(scaled), scaled, scaled**2], -1)
    contrast = scipy.linalg.qr(mean)[0][:, 3:]
    variances, vectors = scipy.linalg.eigh(
        contrast.T @ full @ contrast, contrast.T @ shared @ contrast
    )
    return _Contrasts(contrast @ vectors, np.maximum(variances, 0.0))


def _air(windows: _Windows, lidar: CoherentLidar) -> Air:
    """Turbulence of most separate windows, of which a wake is in few."""
    whole = np.flatnonzero(windows.usable.all(1))
    chosen = _separate(windows, whole)
    if not chosen.size:
        return Air(0.3, LENGTHS[0])
    likelihood = []
    for length in LENGTHS:
        contrasts = _contrasts(windows, lidar, length, np.ones(windows.values.shape[1], bool))
        numbers = windows.values[chosen] @ contrasts.basis
        noise = windows.noise[chosen][:, None]
        variance = _SIGMAS[:, None, None] ** 2 * contrasts.turbulent + noise
        likelihood.append(-(np.log(variance) + numbers**2 / variance).sum(-1) / 2)
        # the determinant, as contrasts of other lengths differ in scale
        determinant = np.linalg.slogdet(contrasts.basis.T @ contrasts.basis)[1]
        likelihood[-1] = likelihood[-1] + determinant / 2
    each = np.stack(likelihood)
    kind = int(np.median(each.max(1), axis=1).argmax())
    return Air(float(np.median(_SIGMAS[each[kind].argmax(0)])), LENGTHS[kind])


def _separate(windows: _Windows, among: np.ndarray) -> np.ndarray:
    """Of these windows, those whose middles are in cells as large as a window."""
    size = np.array([windows.offsets[-1] - windows.offsets[0], _ROWS * _CELL])
    place = np.stack([windows.centre, windows.centre * windows.angle], -1)[among]
    cells = np.floor((place - place.min(0, initial=0)) / size).astype(int)
    return among[np.unique(cells, axis=0, return_index=True)[1]]


def _scores(
    windows: _Windows,
    air: Air,
    lidar: CoherentLidar,
    assumed: Assumptions,
    separations: tuple[float, ...],
    single: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Normalised amplitudes and their Fisher information (templates, windows)."""
    number = 1 if single else len(separations)
    z = np.zeros((number, len(windows.angle)))
    information = np.zeros_like(z)
    kinds = np.round(windows.angle / _ANGLES).astype(int)
    templates = {
        kind: _templates(windows, kind * _ANGLES, lidar, assumed, separations, single)
        for kind in np.unique(kinds)
    }
    packed = np.packbits(windows.usable, axis=1)
    _, which = np.unique(packed, axis=0, return_inverse=True)
    which = _merged_patterns(which.ravel(), windows.usable)
    for p in np.unique(which[which >= 0]):
        at = np.flatnonzero(which == p)
        known_cells = np.asarray(windows.usable[at].all(0))
        contrasts = _contrasts(windows, lidar, air.length, known_cells)
        for kind in np.unique(kinds[at]):
            rows = at[kinds[at] == kind]
            wanted = templates[kind][:, known_cells] @ contrasts.basis
            numbers = windows.values[rows][:, known_cells] @ contrasts.basis
            variance = air.sigma**2 * contrasts.turbulent + windows.noise[rows][:, None]
            information[:, rows] = wanted**2 @ (1 / variance).T
            z[:, rows] = wanted @ (numbers / variance).T
    known = information > 0
    return np.where(known, z / np.sqrt(np.where(known, information, 1)), 0.0), information


def _merged_patterns(which: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Numbers of patterns of usable cells, of which there are at most `_MOST_PATTERNS`.

    Rarer patterns that lack the same rows or columns are replaced by their common part.
    """
    number = np.bincount(which)
    if len(number) <= _MOST_PATTERNS:
        return which
    by_edge = usable.reshape(len(usable), _ROWS, -1)
    # which rows and columns have values
    edges = np.concatenate([by_edge.mean(2) > 0.5, by_edge.mean(1) > 0.5], axis=1)
    return np.unique(edges, axis=0, return_inverse=True)[1].ravel()


def _templates(
    windows: _Windows,
    elevation: float,
    lidar: CoherentLidar,
    assumed: Assumptions,
    separations: tuple[float, ...],
    single: bool,
) -> np.ndarray:
    """Radial velocities (templates, cells) of unit circulation around the middle of a window."""
    # far away lines are parallel
    far = 1e5
    angle = elevation + (np.arange(_ROWS) - _ROWS // 2) * _CELL / far
    same = np.full(_ROWS, _CELL / far)
    lines = lines_of(np.zeros(_ROWS), angle, same, np.zeros(_ROWS), far + windows.offsets, lidar)
    templates = []
    core = math.log(max(assumed.core_radius, 2.0))
    for separation in (0.0,) if single else separations:
        total = np.zeros((_ROWS, windows.offsets.size))
        for side in (1,) if single else (1, -1):
            y = far * math.cos(elevation) + side * separation / 2
            place = np.array([y, far * math.sin(elevation)])
            places = np.broadcast_to(place, (_ROWS, 2, 2))
            strength = np.array([float(side), core])
            total += radial_velocity(lines, places, strength, None, assumed.model)[0]
        templates.append(total.ravel())
    return np.stack(templates)


def _chance(windows: _Windows, z: np.ndarray, score: float, signs: int) -> float:
    """Probability of a larger score somewhere, from the expected Euler characteristic.

    Of a smooth normal field in an area A: Q(u) + sum over edges + A sqrt(det L) u exp(-u^2/2) /
    (2 pi)^(3/2), with the covariance L of its slopes (Adler & Taylor, Random Fields and Geometry,
    2007, theorem 12.4.2); of several fields, the sum.
    """
    u, e = max(score, 0.0), math.exp(-(max(score, 0.0) ** 2) / 2)
    centres, first, counts = np.unique(windows.centre, return_index=True, return_counts=True)
    step = float(np.median(np.diff(centres))) if len(centres) > 1 else math.inf
    across = np.flatnonzero(np.diff(windows.centre) == 0)
    # neighbours in range, at about the same angle
    along, neighbour = [], []
    for k in range(len(centres) - 1):
        ring = np.arange(first[k], first[k] + counts[k])
        next_ring = first[k + 1] + np.arange(counts[k + 1])
        nearest = np.searchsorted(windows.angle[next_ring], windows.angle[ring])
        along.append(ring)
        neighbour.append(next_ring[np.minimum(nearest, len(next_ring) - 1)])
    total = 0.0
    for field in z:
        slope_s = _slope(field[across + 1] - field[across], _CELL)
        slope_r = (
            _slope(field[np.concatenate(along)] - field[np.concatenate(neighbour)], step)
            if along
            else 0.0
        )
        edges = np.ptp(centres) * slope_r + _CELL * counts.max() * slope_s
        area = z.shape[1] * step * _CELL if along else 0.0
        total += (
            scipy.stats.norm.sf(u)
            + edges * e / (2 * math.pi)
            + area * slope_r * slope_s * u * e / (2 * math.pi) ** 1.5
        )
    return float(min(1.0, signs * total))


def _slope(difference: np.ndarray, step: float) -> float:
    """Standard deviation of the slope of a field of unit variance, robust."""
    if not difference.size:
        return 0.0
    # independent neighbours differ by no more
    return min(1.4826 * float(np.median(np.abs(difference))), math.sqrt(2)) / step


def _candidates(
    windows: _Windows,
    signs: np.ndarray,
    z: np.ndarray,
    information: np.ndarray,
    separations: tuple[float, ...],
    single: bool,
    assumed: Assumptions,
) -> list[Candidate]:
    """The best places near the best of all, each some metres from the better ones."""
    places = windows.centre * np.stack([np.cos(windows.angle), np.sin(windows.angle)])
    best = np.unravel_index(int(signs.argmax()), signs.shape)
    near = np.hypot(*(places - places[:, best[1], None])) < _NEAR
    candidates: list[Candidate] = []
    taken: list[np.ndarray] = []
    core = math.log(assumed.core_radius)
    order = np.argsort(np.where(near, signs, -np.inf), axis=None)[::-1]
    for k in order[: int(near.sum()) * len(signs)]:
        template, place = np.unravel_index(int(k), signs.shape)
        # y and z of both vortices, as in the fit
        mark = np.append(places[:, place], 0.0 if single else separations[template] / 2)
        if any(np.abs(mark - better).max() < _APART for better in taken):
            continue
        taken.append(mark)
        gamma = float(z[template, place] / math.sqrt(information[template, place]))
        if single:
            vortices = np.array([[*mark[:2], gamma, core]])
        else:
            vortices = np.array(
                [[mark[0] + side * mark[2], mark[1], side * gamma, core] for side in (-1.0, 1.0)]
            )
        candidates.append(Candidate(vortices, float(signs[template, place])))
        if len(candidates) == _STARTS:
            break
    return candidates
