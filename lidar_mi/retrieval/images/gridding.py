"""Images from scattered beams: values where beams were reported to look, resampled to the nodes."""

import re

import numpy as np
import xarray as xr
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull, KDTree, QhullError

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.resampling_error import (
    LeaveOneOut,
    correlation_area,
    leave_one_out,
    pairs,
    strength_at,
    structure,
    variance,
    variogram,
)

# Beams that a node's value is from, and the width of their covariance, in spacings of the nodes.
_BEAMS, _LENGTH = 25, 1.5
# Uncorrelated variance over that of the structure, and the inverse of that of the structure's
# slope: they keep beams at one place, or in one row, from being a singular set. With 1e-5 noise
# doubles where beams lie irregularly, with 1e-2 texture of 2 px loses 5 % instead of 2 %.
_UNCORRELATED, _SLOPE = 1e-3, 1e-6
# In spacings: offset of a beam that counts as on its node, distance beyond the hull that counts as
# within, distance of a node that has no beam near.
_ON_NODE, _RIM, _NEAR = 1e-3, 0.02, 1.5
# Beams that are estimated from the others.
_MOST_ESTIMATED = 15000
# Nodes solved for together.
_CHUNK = 4096
# Fields that winds are retrieved from.
_IMAGES = ("Y", "Y_noisy", "image")
_ERRORS = re.compile(r".*_(stderr|std)")


def on_nodes(scan: xr.Dataset, *, errors: bool = True) -> xr.Dataset:
    """A scan with its fields on its nodes, from the places its beams were reported to look at.

    Every node's value is the best linear estimate from the 25 nearest beams (ordinary kriging with
    a linear trend: Matheron 1963, Econ. Geol. 58, 1246-1266; Cressie 1993, Statistics for Spatial
    Data, sect. 3.4) for a structure of Gaussian covariance of 1.5 spacings. It passes through the
    beams' values and is exact for fields linear in place. Standard errors follow from the same
    weights and independent errors of the beams. The kriging error of `Y` and `Y_noisy`, and the
    noise that neighbouring nodes share, become `Y_resampling_std` and `Y_noisy_resampling_std`:
    the white noise of the same weight as these correlated errors, see `resampling_error`. The
    `beam_time` is averaged with the same weights, within the times of the scan; where beams next
    to each other have very different times, a node's value mixes times (see `synchronised`).

    scan (..., z, y): with the nodes as coordinates (m, ascending) and `y_reported`, `z_reported`
        (z, y), m: the beams in any order.
    errors: whether to estimate what resampling adds to the noise, which takes most of the time.

    Raises InputError: places that are not finite, or fewer than three.

    Returns
    -------
    xr.Dataset
        Without the places. Fields without the dims z and y do not change, nor do values of beams
        that lie on their own node (to a thousandth of the spacing), bit by bit. NaN beyond the
        beams' convex hull and further than 1.5 spacings from any beam.
    """
    steps = [float(np.ptp(scan[axis].values)) / max(scan.sizes[axis] - 1, 1) for axis in "zy"]
    reported = [scan[f"{axis}_reported"].transpose("z", "y").values.astype(float) for axis in "zy"]
    for axis, values in zip("zy", reported, strict=True):
        if not np.isfinite(values).all():
            raise InputError(
                f"{axis}_reported: {int((~np.isfinite(values)).sum())} beams are not finite; "
                "expected a place in m for every beam"
            )
    grid = np.meshgrid(*(scan[axis].values.astype(float) for axis in "zy"), indexing="ij")
    places, nodes = (
        np.stack([part.ravel() / (step or 1.0) for part, step in zip(axes, steps, strict=True)], -1)
        for axes in (reported, grid)
    )
    gridded = scan.drop_vars(["y_reported", "z_reported"])
    off = np.abs(places - nodes).max(1) > _ON_NODE
    if not off.any():
        return gridded
    if len(places) < 3:
        raise InputError(f"y_reported: {len(places)} beams are not allowed; expected at least 3")
    inside = _inside(places, nodes)
    changed = np.flatnonzero(off & inside)
    weights = _weights(places, nodes[changed])
    images = [name for name in _IMAGES if name in gridded and gridded[name].ndim == 2]
    for name in images if errors else []:
        gridded[f"{name}_resampling_std"] = _resampling_error(
            gridded, name, places, nodes, changed, weights
        )
    for name in [str(n) for n in gridded.data_vars if {"z", "y"} <= set(gridded[n].dims)]:
        field = gridded[name].transpose(..., "z", "y")
        values = field.values.reshape(-1, len(nodes))
        at_nodes = values.astype(values.dtype if values.dtype.kind == "f" else float)
        if name.endswith("_resampling_std"):
            at_nodes[:, ~inside] = np.nan
            gridded[name] = field.copy(data=at_nodes.reshape(field.shape))
            continue
        if _ERRORS.fullmatch(name):
            at_nodes[:, changed] = np.sqrt(weights.power(2) @ values.T.astype(float) ** 2).T
        else:
            at_nodes[:, changed] = (weights @ values.T.astype(float)).T
        if name == "beam_time":  # a mean whose weights may be negative
            at_nodes = at_nodes.clip(values.min(), values.max())
        at_nodes[:, ~inside] = np.nan
        gridded[name] = field.copy(data=at_nodes.reshape(field.shape)).transpose(
            *gridded[name].dims
        )
    return gridded


def _resampling_error(
    scan: xr.Dataset,
    name: str,
    places: np.ndarray,
    nodes: np.ndarray,
    changed: np.ndarray,
    weights: csr_array,
) -> xr.DataArray:
    """Standard deviation of what resampling adds to an image's white noise, of its nodes.

    It is the kriging error of the structure, plus the noise's covariances with all other nodes, by
    which sums of pixels vary.
    """
    image = scan[name].transpose("z", "y")
    values = image.values.ravel().astype(float)
    known = np.isfinite(values)
    values = np.where(known, values, values[known].mean() if known.any() else 0.0)
    times = np.zeros(len(values))
    if "beam_time" in scan:
        times = scan["beam_time"].transpose("z", "y").values.ravel().astype(float)
    speed = variogram(values, pairs(places, times)).speed
    errors = _leave_one_out(places, values, times, speed)
    beams = weights.indices.reshape(len(changed), -1)
    factors = weights.data.reshape(beams.shape)
    when = times[beams]
    when = when - (factors * when).sum(1, keepdims=True).clip(times.min(), times.max())
    error = np.zeros(len(nodes))
    for start in range(0, len(changed), _CHUNK):
        part = slice(start, start + _CHUNK)
        from_node = places[beams[part]] - nodes[changed[part]][:, None]
        error[changed[part]] = variance(structure(speed), factors[part], from_node, when[part])
    error[changed] *= strength_at(errors, nodes[changed])
    error[changed] *= correlation_area(places, nodes[changed])
    # covariance of a node's noise with that of the other nodes
    shared = weights @ weights.sum(0) - weights.power(2).sum(1)
    # a local mean, as single nodes may have a negative sum
    _, around = KDTree(nodes[changed]).query(nodes[changed], min(_BEAMS, len(changed)))
    shared = shared[around].reshape(len(changed), -1).mean(1)
    error[changed] += errors.noise * np.clip(shared, 0.0, None)
    about = {"long_name": f"standard deviation of {name} by resampling"}
    about |= {key: image.attrs[key] for key in ("units",) if key in image.attrs}
    return image.copy(data=np.sqrt(error).reshape(image.shape)).assign_attrs(about)


def _leave_one_out(
    places: np.ndarray, values: np.ndarray, times: np.ndarray, speed: float
) -> LeaveOneOut:
    """Beams estimated from those around them, in the way that nodes are."""
    chosen = np.arange(0, len(places), max(1, round(len(places) / _MOST_ESTIMATED)))
    _, near = KDTree(places).query(places[chosen], min(_BEAMS, len(places) - 1) + 1)
    near = near[:, 1:]
    weights = _weights_of(places, places[chosen], near)
    expected = np.zeros(len(chosen))
    for start in range(0, len(chosen), _CHUNK):
        part = slice(start, start + _CHUNK)
        away = places[near[part]] - places[chosen[part]][:, None]
        delay = times[near[part]] - times[chosen[part]][:, None]
        expected[part] = variance(structure(speed), weights[part], away, delay)
    square = ((weights * values[near]).sum(1) - values[chosen]) ** 2
    return leave_one_out(places[chosen], square, expected, 1 + (weights**2).sum(1))


def _weights(places: np.ndarray, nodes: np.ndarray) -> csr_array:
    """Weight of every beam in the value at every node, (nodes, beams); places in spacings."""
    beams = min(_BEAMS, len(places))
    _, near = KDTree(places).query(nodes, beams)
    weights = _weights_of(places, nodes, near.reshape(len(nodes), beams))
    first = np.arange(len(nodes) + 1) * beams
    return csr_array((weights.ravel(), near.ravel(), first), shape=(len(nodes), len(places)))


def _weights_of(places: np.ndarray, nodes: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Weights of the beams `near` (nodes, beams) in the value at every node."""
    beams = near.shape[1]
    weights = np.zeros(near.shape)
    for start in range(0, len(nodes), _CHUNK):
        chosen = slice(start, start + _CHUNK)
        from_node = places[near[chosen]] - nodes[chosen][:, None]
        separation = from_node[:, :, None] - from_node[:, None]
        matrix = np.zeros((len(from_node), beams + 3, beams + 3))
        matrix[:, :beams, :beams] = _covariance(separation) + _UNCORRELATED * np.eye(beams)
        matrix[:, :beams, beams] = matrix[:, beams, :beams] = 1.0
        matrix[:, :beams, beams + 1 :] = from_node
        matrix[:, beams + 1 :, :beams] = from_node.swapaxes(1, 2)
        matrix[:, [-2, -1], [-2, -1]] = -_SLOPE
        right = np.zeros((len(from_node), beams + 3))
        right[:, :beams], right[:, beams] = _covariance(from_node), 1.0
        weights[chosen] = np.linalg.solve(matrix, right[..., None])[:, :beams, 0]
    return weights


def _covariance(separation: np.ndarray) -> np.ndarray:
    """Covariance of the structure at a distance (..., 2) in spacings."""
    return np.exp(-0.5 * (separation**2).sum(-1) / _LENGTH**2)


def _inside(places: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Whether nodes (n, 2) lie among the beams."""
    try:
        sides = ConvexHull(places).equations
    except QhullError as error:
        raise InputError(
            "y_reported, z_reported: beams in one line are not allowed; expected beams over an area"
        ) from error
    within = np.ones(len(nodes), bool)
    for a, b, offset in sides:
        within &= nodes[:, 0] * a + nodes[:, 1] * b + offset <= _RIM
    distance, _ = KDTree(places).query(nodes, 1)
    return within & (distance <= _NEAR)
