"""Wind vectors from line-of-sight velocities: triples of neighbours, and larger neighbourhoods."""

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import REJECTED, VectorFlag, flag_attributes

COMPONENTS = ("u", "v", "w")
_NAMES = ("v_los", "v_los_std", "direction", "range", "platform_velocity")
# Singular values of directions, smallest over largest, below which they lie in one plane: rounding
# gives 1e-16, lines a second of arc apart 5e-6.
_COPLANAR = 1e-8
# Altitude over longest side of a triangle of lines, over that of the median one.
_THINNEST = 0.1


def wind_along_lines(scan: xr.Dataset) -> np.ndarray:
    """The air's velocity (line,) along every line of sight, away from the instrument, m s-1.

    Direction times wind: the platform's velocity along the line less the measured one, which is
    positive toward the instrument. That velocity is one for all lines, (axis), or each line's own.

    Raises InputError: a variable is missing, has another shape, a direction is no unit vector, or a
    range is not above 0.
    """
    for name in _NAMES:
        if name not in scan:
            raise InputError(f"scan.{name}: missing; expected {', '.join(_NAMES)}")
    # variables, as attaching coordinates takes longer than all checks
    variables = scan.variables
    each_line = {"line"} & set(variables["platform_velocity"].dims)
    for name, dims in (
        ("v_los", {"line"}),
        ("v_los_std", {"line"}),
        ("range", {"line"}),
        ("direction", {"line", "axis"}),
        ("platform_velocity", {"axis"} | each_line),
        ("origin", {"line", "axis"}),
    ):
        if name in variables and set(variables[name].dims) != dims:
            raise InputError(
                f"scan.{name}: dims {variables[name].dims} are not {tuple(sorted(dims))}"
            )
    if scan.sizes["axis"] != 3:
        raise InputError(f"scan.axis: {scan.sizes['axis']} components are not x, y, z")
    direction = variables["direction"].transpose("line", "axis").values
    length = np.linalg.norm(direction, axis=1)
    if not (np.abs(length - 1) < 1e-6).all():
        raise InputError("scan.direction: not of length 1; expected unit vectors")
    if (
        not (variables["range"].values > 0).all()
        or not np.isfinite(variables["range"].values).all()
    ):
        raise InputError("scan.range: not > 0 m everywhere; every line needs its finite range")
    if not (variables["v_los_std"].values[np.isfinite(variables["v_los"].values)] > 0).all():
        raise InputError("scan.v_los_std: not > 0 m/s everywhere; every line needs its error")
    platform = variables["platform_velocity"].transpose(..., "axis").values
    return (direction * platform).sum(1) - variables["v_los"].values


def shared_covariance(scan: xr.Dataset) -> np.ndarray | None:
    """Covariance (line, line) of the lines' errors beyond their variances, (m/s)^2; None: none."""
    if "v_los_covariance" not in scan:
        return None
    return scan.variables["v_los_covariance"].transpose("line", "other_line").values


def line_origins(scan: xr.Dataset) -> np.ndarray:
    """Where lines of sight start, (line, 3), m from the telescope at the scan's reference time."""
    if "origin" not in scan:
        return np.zeros((scan.sizes["line"], 3))
    return scan.variables["origin"].transpose("line", "axis").values


def line_places(scan: xr.Dataset) -> np.ndarray:
    """Middles of the range bins, (line, 3), m from the telescope at the scan's reference time."""
    away = (scan.variables["range"] * scan.variables["direction"]).transpose("line", "axis").values
    return line_origins(scan) + away


def solve_lines(
    directions: np.ndarray, along: np.ndarray, std: np.ndarray, shared: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares for one wind measured along several lines, many times at once.

    directions (n, k, 3): unit vectors.
    along (n, k): wind along them, m/s.
    std (n, k): standard errors, m/s.
    shared (n, k, k): covariance of the errors of different lines, (m/s)^2, 0 on the diagonal. It is
        not used for the wind, but enters its covariance.

    Returns
    -------
    wind : (n, 3) array, m/s
    covariance : (n, 3, 3) array, (m/s)^2
        (sum d d^T / s^2)^-1, plus the shared one; infinite (and the wind NaN) where the lines lie
        in one plane.
    chi_square : (n,) array
        Squared misfit; of k - 3 degrees of freedom if the wind is uniform over the lines.

    Notes
    -----
    k lines evenly around a cone of half angle a about x, each of error s, give u with an error of
    s / (sqrt(k) cos a) and v, w with s sqrt(2 / k) / sin a: at small angles v and w are worse than
    u by sqrt(2) / a.
    """
    matrix = directions / std[..., None]
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    # unweighted, as errors may differ by orders of magnitude
    unweighted = np.linalg.svd(directions, compute_uv=False)
    flat = unweighted[:, -1] <= _COPLANAR * unweighted[:, 0]
    inverse = 1 / np.where(flat[:, None], np.nan, values)
    root = right.swapaxes(-1, -2) * inverse[:, None]
    data = along / std
    wind = np.einsum("nij,nj->ni", root, np.einsum("nki,nk->ni", left, data))
    misfit = data - np.einsum("nki,ni->nk", matrix, wind)
    covariance = root @ root.swapaxes(-1, -2)
    if shared is not None:
        solution = root @ left.swapaxes(-1, -2) / std[:, None, :]
        covariance = covariance + solution @ shared @ solution.swapaxes(-1, -2)
    covariance[flat] = np.inf
    return wind, covariance, (misfit**2).sum(1)


def wind_from_triples(scan: xr.Dataset) -> xr.Dataset:
    """A wind vector at the centre of every triangle of neighbouring lines of sight.

    Neighbours are those of a Delaunay triangulation of the directions (of their tangents, so that
    triangles are those in a plane x = const); the centre is the mean of the middles of the three
    range bins (paper, fig. 1). The wind is assumed uniform over the three lines. Triangles so thin
    that their altitude is below a tenth of the median one's, both over their longest side, have no
    vector: at the rim of lines that are not on a grid they have errors of tens of lines.

    scan (line): `v_los`, `v_los_std`, `range`, `direction` (line, axis), `platform_velocity`
        (axis), as from `lidar_mi.instrument.doppler_scan.scan_wind`; also `origin` (line, axis; m)
        and `v_los_covariance` (line, other_line; m2 s-2) of errors common to lines.

    Raises InputError: fewer than three lines, all of them in one plane, a variable missing.

    Returns
    -------
    xr.Dataset, dim vector
        `u`, `v`, `w` (m s-1), their standard errors and correlations, `x`, `y`, `z` (m), `lines`
        (vector, corner), `flag` (bits of `VectorFlag`).
    """
    along = wind_along_lines(scan)
    tangents = _tangents(scan)
    try:
        corners = scipy.spatial.Delaunay(tangents).simplices
    except scipy.spatial.QhullError:
        raise InputError(
            f"scan.direction: all {len(tangents)} lines lie in one plane; expected three lines "
            "that do not"
        ) from None
    corners = corners[_thinness(tangents[corners]) >= _THINNEST]
    # Qhull's order is arbitrary: sort triangles by the numbers of their lines
    corners = np.sort(corners, axis=1)
    return _vectors(scan, along, corners[np.lexsort(corners.T[::-1])], "triples")


def _thinness(corners: np.ndarray) -> np.ndarray:
    """Altitude over longest side of triangles (n, 3, 2), over the median of all."""
    sides = np.roll(corners, -1, 1) - corners
    doubled = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    shape = doubled / (sides**2).sum(-1).max(1)
    return shape / np.median(shape)


def wind_from_neighbours(scan: xr.Dataset, count: int = 9) -> xr.Dataset:
    """A wind vector for every line of sight, from it and its nearest neighbours by least squares.

    More lines, wider apart, constrain v and w better if the wind is uniform over all of them:
    `misfit` (squared misfit over its degrees of freedom) is 1 then, and more where it is not. The
    standard errors contain the lines' noise only.

    scan: as for `wind_from_triples`; the result is the same, too.
    count: lines per vector, itself included: 3 or more.

    Raises InputError: as there; ``count`` less than 3 or more than there are.
    """
    along = wind_along_lines(scan)
    tangents = _tangents(scan)
    if not 3 <= count <= len(tangents):
        raise InputError(f"count: {count} is not allowed; expected 3 to {len(tangents)}")
    _, nearest = scipy.spatial.KDTree(tangents).query(tangents, k=count)
    return _vectors(scan, along, nearest, "neighbours")


def _tangents(scan: xr.Dataset) -> np.ndarray:
    directions = scan["direction"].transpose("line", "axis").values
    if len(directions) < 3:
        raise InputError(
            f"scan: {len(directions)} lines of sight are not enough for a wind vector; expected 3"
        )
    if not (directions[:, 0] > 0).all():
        raise InputError("scan.direction: a line goes backward; expected x > 0 for all of them")
    return directions[:, 1:] / directions[:, :1]


def _vectors(scan: xr.Dataset, along: np.ndarray, lines: np.ndarray, method: str) -> xr.Dataset:
    directions = scan["direction"].transpose("line", "axis").values[lines]
    values, std = along[lines], scan["v_los_std"].values[lines]
    missing = ~np.isfinite(values).all(1)
    shared = shared_covariance(scan)
    if shared is not None:
        shared = np.nan_to_num(shared[lines[:, :, None], lines[:, None]])
    # a placeholder: these results become NaN below
    wind, covariance, chi_square = solve_lines(
        directions,
        np.where(missing[:, None], 0.0, values),
        np.where(missing[:, None], 1.0, std),
        shared,
    )
    flat = np.isinf(covariance[:, 0, 0])
    wind[missing], covariance[missing | flat] = np.nan, np.nan
    flag = VectorFlag.COPLANAR * flat + VectorFlag.NO_VELOCITY * missing
    freedom = lines.shape[1] - 3
    misfit = {}
    if freedom:
        text = {"units": "1", "long_name": "squared misfit per degree of freedom"}
        misfit["misfit"] = "vector", np.where(missing | flat, np.nan, chi_square / freedom), text
    centre = line_places(scan)[lines].mean(1)
    return xr.Dataset(
        {
            **error_variables("vector", covariance),
            **{
                name: ("vector", wind[:, index], {"units": "m s-1", "long_name": _LONG[name]})
                for index, name in enumerate(COMPONENTS)
            },
            **misfit,
            "lines": (("vector", "corner"), lines, {"long_name": "lines of sight, as counted"}),
            "flag": ("vector", flag.astype(np.uint16), flag_attributes(VectorFlag, REJECTED)),
        },
        coords={
            name: ("vector", centre[:, index], {"units": "m", "long_name": f"{name} of the vector"})
            for index, name in enumerate("xyz")
        },
        attrs={
            "Conventions": "CF-1.11",
            "title": "Wind vectors from lines of sight",
            "method": method,
        },
    )


_LONG = {"u": "wind along x", "v": "wind along y", "w": "wind along z"}


def error_variables(
    dims: str | tuple[str, ...], covariance: np.ndarray
) -> dict[str, tuple[str | tuple[str, ...], np.ndarray, dict[str, str]]]:
    """Standard errors and correlations of u, v, w from covariances (..., 3, 3), as variables."""
    stderr = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    variables = {
        f"{name}_stderr": (
            dims,
            stderr[..., index],
            {"units": "m s-1", "long_name": f"standard error of {name}"},
        )
        for index, name in enumerate(COMPONENTS)
    }
    for i, j in ((0, 1), (0, 2), (1, 2)):
        product = stderr[..., i] * stderr[..., j]
        correlation = np.divide(
            covariance[..., i, j], product, out=np.zeros_like(product), where=product > 0
        )
        correlation[np.isnan(product)] = np.nan
        first, second = COMPONENTS[i], COMPONENTS[j]
        text = {"units": "1", "long_name": f"correlation of the errors of {first} and {second}"}
        variables[f"{first}{second}_correlation"] = (dims, correlation, text)
    return variables
