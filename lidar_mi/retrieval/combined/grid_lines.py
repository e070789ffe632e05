"""Lines of sight as weighted sums over the nodes of a grid, and covariances of such sums."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.combined.crossflow import Crossflow
from lidar_mi.retrieval.combined.vectors import (
    line_origins,
    line_places,
    shared_covariance,
    wind_along_lines,
)

# Points along a range bin: Gauss-Legendre, exact for winds of degree 9.
_ALONG = 5

# Numbers in the largest temporary array.
CHUNK_NUMBERS = 2e7


class GridLines(NamedTuple):
    """Lines of sight as sums over nodes of the grid: of row z and column y with weight.

    ``covariance`` is that of the lines' errors. ``forward`` is the weight of u at the nodes: its
    projection on the line, and the part of it that the images attribute to v and w.
    """

    direction: np.ndarray
    along: np.ndarray
    covariance: np.ndarray
    z: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    forward: np.ndarray


def with_slopes(lines: GridLines, slope: np.ndarray) -> GridLines:
    """Lines whose ``forward`` includes the part of u that the images attribute to v and w."""
    more = np.einsum("lkc,lc->lk", slope[lines.z, lines.y], lines.direction[:, 1:])
    return lines._replace(forward=lines.weight * (lines.direction[:, :1] + more))


def lines_on_grid(scan: xr.Dataset, z: np.ndarray, y: np.ndarray) -> tuple[GridLines, np.ndarray]:
    """Lines on the grid, and the (y, z) of the middles of their bins."""
    along = wind_along_lines(scan)
    if "range_bin" not in scan:
        raise InputError("scan.range_bin: missing; expected the length of the range bins, m")
    direction = scan.variables["direction"].transpose("line", "axis").values
    nodes, weights = np.polynomial.legendre.leggauss(_ALONG)
    half = np.broadcast_to(scan.variables["range_bin"].values, len(along)) / 2
    reach = scan.variables["range"].values[:, None] + half[:, None] * nodes
    origin = line_origins(scan)
    place = {
        axis: origin[:, k : k + 1] + reach * direction[:, k : k + 1]
        for axis, k in (("y", 1), ("z", 2))
    }
    used = np.isfinite(along)
    corners = {}
    for name, axis in (("z", z), ("y", y)):
        step = (place[name] - axis[0]) / (axis[-1] - axis[0]) * (len(axis) - 1)
        # a place on the last node may lie outside by rounding
        used &= ((step > -1e-9) & (step < len(axis) - 1 + 1e-9)).all(1)
        low = np.clip(np.floor(step), 0, len(axis) - 2).astype(int)
        corners[name] = low, step - low
    if not used.any():
        raise InputError(
            f"scan: none of {len(along)} lines of sight with a velocity stays within the images' "
            f"y from {y[0]:g} to {y[-1]:g} m and z from {z[0]:g} to {z[-1]:g} m"
        )
    (low_z, part_z), (low_y, part_y) = corners["z"], corners["y"]
    half_weights = weights / 2
    parts = [
        (low_z + dz, low_y + dy, half_weights * _part(part_z, dz) * _part(part_y, dy))
        for dz in (0, 1)
        for dy in (0, 1)
    ]
    row, column, weight = (np.concatenate(p, axis=1)[used] for p in zip(*parts, strict=True))
    covariance = np.diag(scan.variables["v_los_std"].values[used] ** 2)
    shared = shared_covariance(scan)
    if shared is not None:
        covariance = covariance + shared[np.ix_(used, used)]
    direction = direction[used]
    forward = weight * direction[:, :1]
    middle = line_places(scan)[used, 1:]
    return GridLines(direction, along[used], covariance, row, column, weight, forward), middle


def _part(fraction: np.ndarray, side: int) -> np.ndarray:
    return fraction if side else 1 - fraction


def crossflow_weights(field: Crossflow, lines: GridLines) -> np.ndarray:
    """Weights (lines, nodes, 2) of the whitened errors of v, w in the lines' velocities."""
    root = field.root[lines.z, lines.y]
    return lines.weight[..., None] * np.einsum("lkab,la->lkb", root, lines.direction[:, 1:])


def covariances_of_lines(
    lines: GridLines, weight: np.ndarray, correlations: Iterable[tuple[np.ndarray, np.ndarray]]
) -> Iterator[np.ndarray]:
    """Covariances (parts, lines, lines) of sums over correlated nodes, one for each correlation.

    ``weight`` is (lines, nodes, parts); ``correlations`` are those of the nodes along z and y.
    """
    columns = int(lines.y.max()) + 1
    # neighbouring lines meet the same nodes: each is computed once
    place, node = np.unique(lines.z * columns + lines.y, return_inverse=True)
    z, y = np.divmod(place, columns)
    count, parts = len(weight), weight.shape[-1]
    row = np.repeat(np.arange(count), weight.shape[1])
    sums = [
        scipy.sparse.csr_array(
            (weight[..., part].ravel(), (row, node.ravel())), (count, len(place))
        )
        for part in range(parts)
    ]
    together = scipy.sparse.vstack(sums, "csr")
    step = max(1, int(CHUNK_NUMBERS / len(place)))
    chunks = [slice(start, start + step) for start in range(0, len(place), step)]
    pieces = [[matrix[:, chunk] for matrix in sums] for chunk in chunks]
    for over_z, over_y in correlations:
        result = np.zeros((parts, count, count))
        for chunk, some in zip(chunks, pieces, strict=True):
            # rows and columns one after the other: a fourth of the time of pairs of indices
            kernel = over_z.take(z, 0).take(z[chunk], 1)
            kernel *= over_y.take(y, 0).take(y[chunk], 1)
            across = (together @ kernel).reshape(parts, count, -1)
            for part, piece in enumerate(some):
                result[part] += (piece @ across[part].T).T
        yield result


def covariance_of_lines(
    lines: GridLines, weight: np.ndarray, over_z: np.ndarray, over_y: np.ndarray
) -> np.ndarray:
    """As `covariances_of_lines`, for one correlation."""
    (covariance,) = covariances_of_lines(lines, weight, [(over_z, over_y)])
    return covariance


def covariance_with_nodes(
    rows: slice, lines: GridLines, weight: np.ndarray, over_z: np.ndarray, over_y: np.ndarray
) -> np.ndarray:
    """Covariance of the sums of `covariance_of_lines` with nodes of rows, (parts, z, y, lines)."""
    along_z = over_z[rows][:, lines.z].swapaxes(0, 1)
    along_y = over_y[:, lines.y].swapaxes(0, 1)
    return np.stack(
        [
            np.matmul((along_z * weight[:, None, :, part]), along_y.swapaxes(1, 2))
            for part in range(weight.shape[-1])
        ]
    ).transpose(0, 2, 3, 1)


def line_spacing(lines: GridLines, z: np.ndarray, y: np.ndarray) -> float:
    """Mean spacing of the lines, m."""
    extent = max(np.ptp(z[lines.z]), np.ptp(y[lines.y]), z[1] - z[0])
    return extent / np.sqrt(len(lines.along))
