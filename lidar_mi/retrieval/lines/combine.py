"""Both lidars' winds as one field: u from the Doppler lidar, v and w from the backscatter lidar.

Every line of sight measures a projection of the wind, every image window v and w. The best linear
estimate from both (generalised least squares, also called optimal interpolation) gives all three
components on the images' grid, with their covariance.
"""

import enum
import itertools
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import ndimage, sparse
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial import ConvexHull, QhullError

from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_image
from lidar_mi.retrieval.lines.vectors import (
    COMPONENTS,
    error_variables,
    flag_attributes,
    wind_along_lines,
)

# Points along a range bin: Gauss-Legendre, exact for winds of degree 9.
_ALONG = 5
# Values of u's standard deviation, m/s, and number of lengths that the evidence is averaged over.
_STDS = np.geomspace(0.05, 10, 16)
_LENGTHS = 8
# Powers of the cross-flow's shear that u's standard deviation may go with.
_POWERS = (0.0, 0.5, 1.0)
# Exponents of u's correlation: rough as turbulence, and smooth.
_EXPONENTS = (1.0, 2.0)
# Number of such statistics that stand for all, as often as they are probable.
_DRAWN = 16
# How far v and w are from their mean where the images gave none, in standard deviations of the
# others: vectors are rejected where the wind varies most.
_UNSEEN = 2.0
# Standard deviation of the mean of u before anything is measured, m/s.
_MEAN_STD = 100.0
_CHUNK_NUMBERS = 2e7


class CombinedFlag(enum.IntFlag):
    """Why a vector is rejected, one bit a reason; 0 is a good vector."""

    NO_CROSSFLOW = 1
    """The images gave no good vector here: u alone."""
    BEYOND_LINES = 2
    """Outside the lines of sight: u is extrapolated from the nearest."""


class _Lines(NamedTuple):
    """Lines of sight as sums over nodes of the grid: of row z and column y with weight.

    ``forward`` is the weight of u at the nodes: what the line sees of it, and what the images took
    for v and w of it.
    """

    direction: np.ndarray
    along: np.ndarray
    variance: np.ndarray
    z: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    forward: np.ndarray


class _Crossflow(NamedTuple):
    """v and w of the images on the grid, arrays (z, y, ...).

    ``root`` is the Cholesky factor of the errors' covariance. Where a vector is not ``good`` the
    value is the mean of those that are, known to ``spread`` (2,).
    """

    value: np.ndarray
    root: np.ndarray
    good: np.ndarray
    spread: np.ndarray


def combine(
    crossflow: xr.Dataset,
    scan: xr.Dataset,
    *,
    crossflow_std: float | None = None,
    window: float | None = None,
    u_std: float | None = None,
    u_length: float | None = None,
    u_power: float | None = None,
    u_exponent: float | None = None,
    distance: float | None = None,
    gate_speed: float = 0.0,
) -> xr.Dataset:
    """The wind (u, v, w) on the images' grid from both lidars.

    Parameters
    ----------
    crossflow : xr.Dataset, dims (z, y)
        From `lidar_mi.retrieval.velocimetry.wind.retrieve_wind`: `v`, `w`, `v_stderr`, `w_stderr`,
        `vw_correlation`, `flag`. Vectors are taken at the nodes.
    scan : xr.Dataset, dim line
        Line-of-sight velocities of the same air, as for `line_of_sight.wind_from_triples`, with
        `range_bin`. A line of sight averages the wind over its bin, along its oblique way through
        the (y, z) plane; the wind is taken to be the same along x. Lines that leave the grid, or
        have no velocity, are not used.
    crossflow_std : float, optional
        Standard error of v and w, m/s, in place of the data set's own (methods that know none).
    window : float, optional
        Size of the windows, m, over which errors of v and w are correlated: by the share by which
        two windows overlap. By default the data set's ``template`` in metres; 0: not correlated.
    u_std, u_length : float, optional
        How u varies about its mean, m/s, and over which length, m. Left out: averaged over values
        of both, each as probable as what was measured makes it, from 0.05 to 10 m/s (all as
        probable beforehand) and from a quarter of the lines' spacing to twice their extent (all
        octaves as probable).
    u_power : float, optional
        u's standard deviation goes with this power of the shear of v and w about a place, and is
        ``u_std`` in the rms over the lines: 0 is even. Left out: averaged over 0, 0.5 and 1 likewise.
    u_exponent : float, optional
        a of u's correlation, exp(-(|dy|^a + |dz|^a) / length^a), above 0 and up to 2: 1 is rough, as
        turbulence is, 2 smooth. Left out: averaged over 1 and 2 likewise.
    distance : float, optional
        Of the images' plane x = const from the telescope, m: air that moves along x by dx while
        their gates do not shifts by -y / distance dx, -z / distance dx in them, as oblique beams look
        at it. Left out: images show no motion along x, as of air that is the same along it.
    gate_speed : float
        Of the images' gates over the ground along x, m/s; matters with ``distance``.

    Returns
    -------
    xr.Dataset, dims (z, y)
        `u`, `v`, `w` (m s-1), their standard errors and correlations, `flag` (bits of
        `CombinedFlag`). Where the images gave no vector, v and w are NaN, and lines count for
        less: there v and w are taken to be the others' mean, give or take twice their scatter. Attributes: `lines_used`,
        `misfit` (of the lines, 1 where errors are as stated), and `u_std`, `u_length`, `u_power` and
        `u_exponent` of largest evidence.

    Raises
    ------
    InputError
        No good vector, no line on the grid, an error that is not known.

    Notes
    -----
    With x the wind at all nodes, x_b and P what is known without the lines (v, w of the images with
    their errors; u by its statistics, of unknown mean) and b = H x + e what the lines measured, e
    of variance R,

        x = x_b + P H^T S^-1 (b - H x_b),   S = H P H^T + R,   P_x = P - P H^T S^-1 H P .

    A line through nodes of good v and w says what u is there; a little is said on v and w too. The
    stated errors are as good as those of v, w and v_LOS (an error of the attitude or of the pointing
    that ``v_los_std`` does not hold is not in them), and hold for u as far as it varies evenly, or
    more where v and w do. Between lines they rest on what lines can tell. Over an ensemble of flows 71 %
    of the errors of u lie within one standard error and 94 % within 1.96
    (tests/retrieval/lines/test_combine_ensemble.py); where u is half the noise of a line, 60 and 84 %, where
    it is smooth over the lines' spacing, or near zero but for a few jets, 80 to 90 and 97 %.
    """
    field = _crossflow(crossflow, crossflow_std)
    z, y = (crossflow[axis].values.astype(float) for axis in ("z", "y"))
    lines, hull = _lines(scan, z, y)
    slope = _slopes(z, y, distance)
    # v and w where u is the gates' speed; what u is beyond that is seen along with them
    field = field._replace(value=field.value - gate_speed * slope)
    lines = _with_slopes(lines, slope)
    if window is None:
        window = _window(crossflow)
    elif not window >= 0:
        raise InputError(f"window: {window} m is not allowed; expected >= 0 m")
    tent = [_tent(axis, window) for axis in (z, y)]

    forward, across = lines.forward.sum(1), lines.direction[:, 1:]
    mean = np.einsum("lk,lkc->lc", lines.weight, field.value[lines.z, lines.y])
    residual = lines.along - (across * mean).sum(1)
    unseen = (lines.weight * ~field.good[lines.z, lines.y]).sum(1)
    fixed = np.diag(lines.variance + unseen**2 * (across**2 @ field.spread**2))
    fixed += _MEAN_STD**2 * np.outer(forward, forward)
    fixed += _between_lines(lines, _pull(field, lines), *tent).sum(0)

    spacing = _spacing(lines, z, y)
    strengths = _strengths(field, lines, z, y, spacing, u_power)
    asked = u_std, u_length, u_exponent
    found, best = _statistics(fixed, residual, lines, z, y, spacing, strengths, asked)
    good = field.good
    wind = np.zeros((*good.shape, 3))
    covariance = np.zeros((*good.shape, 3, 3))
    rows = max(1, int(_CHUNK_NUMBERS / (3 * len(residual) * len(y))))
    for start in range(0, len(z), rows):
        chunk = slice(start, start + rows)
        wind[chunk], covariance[chunk] = _posterior(
            chunk, field, lines, tent, found, strengths, residual, z, y
        )
    wind[..., 1:] += slope * wind[..., :1]
    turn = np.zeros((*good.shape, 3, 3)) + np.eye(3)
    turn[..., 1:, 0] = slope
    covariance = turn @ covariance @ turn.swapaxes(-1, -2)
    wind[~good, 1:] = np.nan
    covariance[~good, 1:] = covariance[~good, :, 1:] = np.nan
    flag = CombinedFlag.NO_CROSSFLOW * ~good + CombinedFlag.BEYOND_LINES * ~_inside(hull, z, y)
    return _dataset(
        crossflow,
        wind,
        covariance,
        flag,
        {
            "lines_used": len(residual),
            "misfit": best.misfit,
            "u_std": best.std,
            "u_length": best.length,
            "u_power": best.power,
            "u_exponent": best.exponent,
            "window": window,
        },
    )


def _slopes(z: np.ndarray, y: np.ndarray, distance: float | None) -> np.ndarray:
    """By how much v and w of the images fall short for each m/s of u over the gates', (z, y, 2)."""
    if distance is None:
        return np.zeros((len(z), len(y), 2))
    if not distance > 0:
        raise InputError(f"distance: {distance} m is not allowed; expected more than 0 m")
    return np.stack(np.meshgrid(y, z), -1) / distance


def _with_slopes(lines: _Lines, slope: np.ndarray) -> _Lines:
    """Lines where a part of u is among v and w of the images."""
    more = np.einsum("lkc,lc->lk", slope[lines.z, lines.y], lines.direction[:, 1:])
    return lines._replace(forward=lines.weight * (lines.direction[:, :1] + more))


class _Choice(NamedTuple):
    """One statistics of u: how it varies, its share of the evidence, S, misfit."""

    std: float
    length: float
    power: float
    exponent: float
    share: float
    factor: tuple
    misfit: float


def _crossflow(wind: xr.Dataset, std: float | None) -> _Crossflow:
    for name in ("v", "w", "flag"):
        if name not in wind:
            raise InputError(f"crossflow.{name}: missing; expected v, w and flag on (z, y)")
        checked_image(f"crossflow.{name}", wind[name])
    value = np.stack([wind[n].transpose("z", "y").values.astype(float) for n in ("v", "w")], -1)
    if std is not None:
        if not std > 0:
            raise InputError(f"crossflow_std: {std} m/s is not allowed; expected more than 0 m/s")
        first = second = np.full(value.shape[:2], float(std))
        correlation = np.zeros_like(first)
    else:
        names = ("v_stderr", "w_stderr", "vw_correlation")
        if any(n not in wind or not np.isfinite(wind[n]).any() for n in names):
            method = wind.attrs.get("method", "unknown")
            raise InputError(
                f"crossflow.v_stderr: not known by method {method!r}; give crossflow_std"
            )
        first, second, correlation = (
            wind[n].transpose("z", "y").values.astype(float) for n in names
        )
    good = (wind["flag"].transpose("z", "y").values == 0) & np.isfinite(value).all(-1)
    good &= (first > 0) & (second > 0) & (abs(correlation) < 1)
    if not good.any():
        raise InputError("crossflow.flag: every vector is flagged; expected some good ones")
    root = np.zeros((*good.shape, 2, 2))
    root[..., 0, 0] = first
    root[..., 1, 0] = correlation * second
    root[..., 1, 1] = np.sqrt(1 - correlation**2) * second
    root[~good] = 0.0
    around, spread = value[good].mean(0), _UNSEEN * value[good].std(0)
    return _Crossflow(np.where(good[..., None], value, around), root, good, spread)


def _lines(scan: xr.Dataset, z: np.ndarray, y: np.ndarray) -> tuple[_Lines, np.ndarray]:
    """Lines on the grid, and the (y, z) of the middles of their bins."""
    along = wind_along_lines(scan).values
    if "range_bin" not in scan:
        raise InputError("scan.range_bin: missing; expected the length of the range bins, m")
    direction = scan["direction"].transpose("line", "axis").values
    nodes, weights = np.polynomial.legendre.leggauss(_ALONG)
    half = np.broadcast_to(scan["range_bin"].values, len(along)) / 2
    reach = scan["range"].values[:, None] + half[:, None] * nodes
    place = {"y": reach * direction[:, 1:2], "z": reach * direction[:, 2:]}
    used = np.isfinite(along)
    corners = {}
    for name, axis in (("z", z), ("y", y)):
        step = (place[name] - axis[0]) / (axis[-1] - axis[0]) * (len(axis) - 1)
        # a place on the last node may be off by rounding
        used &= ((step > -1e-9) & (step < len(axis) - 1 + 1e-9)).all(1)
        low = np.clip(np.floor(step), 0, len(axis) - 2).astype(int)
        corners[name] = low, step - low
    if not used.any():
        raise InputError(
            f"scan: none of {len(along)} lines of sight with a velocity stays within the images' "
            f"y from {y[0]:g} to {y[-1]:g} m and z from {z[0]:g} to {z[-1]:g} m"
        )
    (low_z, part_z), (low_y, part_y) = corners["z"], corners["y"]
    share = weights / 2
    parts = [
        (low_z + dz, low_y + dy, share * _part(part_z, dz) * _part(part_y, dy))
        for dz in (0, 1)
        for dy in (0, 1)
    ]
    row, column, weight = (np.concatenate(p, axis=1)[used] for p in zip(*parts))
    variance = scan["v_los_std"].values[used] ** 2
    middle = np.stack([scan["range"].values * direction[:, k] for k in (1, 2)], -1)
    direction = direction[used]
    forward = weight * direction[:, :1]
    return _Lines(direction, along[used], variance, row, column, weight, forward), middle[used]


def _part(fraction, side):
    return fraction if side else 1 - fraction


def _window(crossflow: xr.Dataset) -> float:
    try:
        pixels = crossflow.attrs["template"] / crossflow.attrs["stride"]
    except KeyError:
        raise InputError(
            "crossflow: attributes template and stride missing; give window in m"
        ) from None
    return float(pixels * np.diff(crossflow["y"].values.astype(float)).mean())


def _tent(axis: np.ndarray, window: float) -> np.ndarray:
    """Share by which windows on the nodes of an axis overlap, (n, n)."""
    distance = abs(axis[:, None] - axis)
    if window == 0:
        return np.eye(len(axis))
    return np.clip(1 - distance / window, 0, None)


def _pull(field: _Crossflow, lines: _Lines) -> np.ndarray:
    """Weights (lines, nodes, 2) of v, w in units of their errors in the lines' velocities."""
    root = field.root[lines.z, lines.y]
    return lines.weight[..., None] * np.einsum("lkab,la->lkb", root, lines.direction[:, 1:])


def _between_lines(lines: _Lines, weight: np.ndarray, over_z, over_y) -> np.ndarray:
    """Covariance (parts, lines, lines) of sums with weights (lines, nodes, parts) of correlated nodes."""
    place, node = np.unique(lines.z * len(over_y) + lines.y, return_inverse=True)
    z, y = np.divmod(place, len(over_y))
    count, parts = len(weight), weight.shape[-1]
    row = np.repeat(np.arange(count), weight.shape[1])
    sums = [
        sparse.csr_array((weight[..., part].ravel(), (row, node.ravel())), (count, len(place)))
        for part in range(parts)
    ]
    result = np.zeros((parts, count, count))
    step = max(1, int(_CHUNK_NUMBERS / len(place)))
    for start in range(0, len(place), step):
        chunk = slice(start, start + step)
        kernel = over_z[z][:, z[chunk]] * over_y[y][:, y[chunk]]
        for part, matrix in enumerate(sums):
            result[part] += (matrix[:, chunk] @ (matrix @ kernel).T).T
    return result


def _onto_nodes(rows: slice, lines: _Lines, weight: np.ndarray, over_z, over_y) -> np.ndarray:
    """Covariance of such sums with the nodes of some rows, (parts, z, y, lines)."""
    along_z = over_z[rows][:, lines.z].swapaxes(0, 1)
    along_y = over_y[:, lines.y].swapaxes(0, 1)
    return np.stack(
        [
            np.matmul((along_z * weight[:, None, :, part]), along_y.swapaxes(1, 2))
            for part in range(weight.shape[-1])
        ]
    ).transpose(0, 2, 3, 1)


def _correlation(axis: np.ndarray, length: float, exponent: float) -> np.ndarray:
    return np.exp(-((abs(axis[:, None] - axis) / length) ** exponent))


def _spacing(lines: _Lines, z: np.ndarray, y: np.ndarray) -> float:
    """Of the lines, m."""
    extent = max(np.ptp(z[lines.z]), np.ptp(y[lines.y]), z[1] - z[0])
    return extent / np.sqrt(len(lines.along))


def _strengths(field, lines, z, y, spacing, power) -> dict[float, np.ndarray]:
    """Standard deviation of u at the nodes in units of u_std, (z, y), by the power of the shear."""
    if power is not None and not power >= 0:
        raise InputError(f"u_power: {power} is not allowed; expected >= 0")
    square, known = np.zeros(field.good.shape), np.zeros(field.good.shape)
    for axis, nodes in enumerate((z, y)):
        step = np.diff(nodes).mean()
        both = np.stack([np.roll(field.good, shift, axis) for shift in (1, -1)]).all(0)
        edge = np.arange(len(nodes))[[0, -1]]
        both[(slice(None),) * axis + (edge,)] = False
        change = np.roll(field.value, -1, axis) - np.roll(field.value, 1, axis)
        square += np.where(both, ((change / (2 * step)) ** 2).sum(-1), 0)
        known += both
    # over the lines' spacing: finer than this they do not tell how u varies
    width = [spacing / np.diff(nodes).mean() for nodes in (z, y)]
    square, known = (ndimage.gaussian_filter(a, width, mode="constant") for a in (square, known))
    even = np.ones_like(square)
    seen = known > 1e-3
    if not (square[seen] > 0).any():
        return {0.0: even} if power is None else {power: even}
    shear = np.sqrt(square / np.where(seen, known, 1))
    shear = np.where(seen, shear, shear[seen].mean())
    shear = np.maximum(shear, 1e-3 * shear.max())
    found = {}
    for one in _POWERS if power is None else (power,):
        strength = shear**one
        found[one] = strength / np.sqrt(
            (strength[lines.z, lines.y] ** 2 * lines.weight).sum(1).mean()
        )
    return found


def _statistics(
    fixed, residual, lines, z, y, spacing, strengths, asked
) -> tuple[list[_Choice], _Choice]:
    """Statistics of u that stand for all, and those of largest evidence.

    Standard deviations are uniform beforehand, which favours no small ones where lines are too
    noisy to tell (Gelman 2006, Bayesian Analysis 1, 515-533); lengths are so in their logarithm. What
    the lines' velocities make of each is its evidence. Some are drawn at even steps of the sum of
    their shares: each counts alike.
    """
    std, length, exponent = asked
    for name, value, unit in (("u_std", std, "m/s"), ("u_length", length, "m")):
        if value is not None and not value > 0:
            raise InputError(f"{name}: {value} {unit} is not allowed; expected more than 0 {unit}")
    if exponent is not None and not 0 < exponent <= 2:
        raise InputError(f"u_exponent: {exponent} is not allowed; expected more than 0, up to 2")
    stds = _STDS if std is None else np.array([float(std)])
    extent = spacing * np.sqrt(len(residual))
    lengths = np.geomspace(spacing / 4, 2 * extent, _LENGTHS) if length is None else [length]
    exponents = _EXPONENTS if exponent is None else (float(exponent),)
    pull = np.stack([lines.forward * s[lines.z, lines.y] for s in strengths.values()], -1)
    choices, shapes, evidence = [], [], []
    for one_exponent, one_length in itertools.product(exponents, lengths):
        correlations = [_correlation(axis, one_length, one_exponent) for axis in (z, y)]
        for power, shape in zip(strengths, _between_lines(lines, pull, *correlations)):
            for one_std in stds:
                factor = cho_factor(fixed + one_std**2 * shape, lower=True)
                square = float(residual @ cho_solve(factor, residual))
                evidence.append(-np.log(np.diag(factor[0])).sum() - square / 2)
                shapes.append(shape)
                choices.append(
                    _Choice(
                        float(one_std),
                        float(one_length),
                        float(power),
                        one_exponent,
                        0.0,
                        (),
                        square / len(residual),
                    )
                )
    # steps of the standard deviation grow with it
    share = np.exp(np.array(evidence) - max(evidence)) * [choice.std for choice in choices]
    share /= share.sum()
    steps = (np.arange(_DRAWN) + 0.5) / _DRAWN
    drawn = np.searchsorted(np.cumsum(share), steps).clip(max=len(choices) - 1)
    found = [
        choices[k]._replace(
            share=times / _DRAWN,
            factor=cho_factor(fixed + choices[k].std ** 2 * shapes[k], lower=True),
        )
        for k, times in zip(*np.unique(drawn, return_counts=True))
    ]
    return found, choices[int(np.argmax(evidence))]


def _posterior(rows, field, lines, tent, choices, strengths, residual, z, y):
    """Wind (z, y, 3) and covariance (z, y, 3, 3) at the nodes of some rows."""
    root = field.root[rows]
    across = _onto_nodes(rows, lines, _pull(field, lines), *tent)
    across = np.einsum("zyab,bzyl->azyl", root, across)
    known = np.einsum("zyab,zycb->zyac", root, root)
    prior = np.concatenate([np.zeros((*field.value[rows].shape[:2], 1)), field.value[rows]], -1)
    winds, covariances = [], []
    for choice in choices:
        correlations = [_correlation(axis, choice.length, choice.exponent) for axis in (z, y)]
        strength = choice.std * strengths[choice.power]
        pull = (lines.forward * strength[lines.z, lines.y])[..., None]
        (along,) = strength[rows, :, None] * _onto_nodes(rows, lines, pull, *correlations)
        along = _MEAN_STD**2 * lines.forward.sum(1) + along
        both = np.concatenate([along[None], across])
        shape = both.shape
        whitened = solve_triangular(choice.factor[0], both.reshape(-1, shape[-1]).T, lower=True)
        whitened = whitened.reshape(shape[-1], *shape[:-1])
        data = solve_triangular(choice.factor[0], residual, lower=True)
        winds.append(prior + np.einsum("lazy,l->zya", whitened, data))
        covariance = -np.einsum("lazy,lbzy->zyab", whitened, whitened, optimize=True)
        covariance[..., 0, 0] += _MEAN_STD**2 + strength[rows] ** 2
        covariance[..., 1:, 1:] += known
        covariances.append(covariance)
    share = np.array([choice.share for choice in choices])
    wind = np.tensordot(share, winds, 1)
    apart = np.array(winds) - wind
    spread = np.einsum("n,nzya,nzyb->zyab", share, apart, apart)
    return wind, np.tensordot(share, covariances, 1) + spread


def _inside(middles: np.ndarray, z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether nodes lie among the lines, (z, y)."""
    places = np.stack(np.meshgrid(y, z), -1)
    try:
        sides = ConvexHull(middles).equations
    except (QhullError, ValueError):  # lines in a row, or fewer than three
        return np.zeros(places.shape[:2], bool)
    # distances beyond the sides, m
    return (places @ sides[:, :2].T + sides[:, 2] <= 1e-9).all(-1)


def _dataset(crossflow, wind, covariance, flag, attributes) -> xr.Dataset:
    names = {
        "u": ("wind along x", "x_wind"),
        "v": ("wind along y", "y_wind"),
        "w": ("wind along z", "upward_air_velocity"),
    }
    dims = ("z", "y")
    return xr.Dataset(
        {
            **{
                name: (
                    dims,
                    wind[..., index],
                    {
                        "units": "m s-1",
                        "long_name": names[name][0],
                        "standard_name": names[name][1],
                    },
                )
                for index, name in enumerate(COMPONENTS)
            },
            **error_variables(dims, covariance),
            "flag": (dims, flag.astype(np.uint8), flag_attributes(CombinedFlag)),
        },
        coords={axis: crossflow[axis] for axis in dims},
        attrs={
            "Conventions": "CF-1.11",
            "title": "Wind from a Doppler and a backscatter lidar",
            **attributes,
            "u_std_units": "m s-1",
            "u_length_units": "m",
            "window_units": "m",
        },
    )
