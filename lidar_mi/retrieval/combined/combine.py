"""Both lidars' winds as one field: u from the Doppler lidar, v and w from the backscatter lidar.

Every line of sight measures a projection of the wind, every image window v and w. The best linear
estimate from both (generalised least squares, also called optimal interpolation) gives all three
components on the images' grid, with their covariance.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import REJECTED, CombinedFlag, flag_attributes
from lidar_mi.retrieval.combined.common_time import at_common_time
from lidar_mi.retrieval.combined.crossflow import (
    Crossflow,
    apparent_slopes,
    checked_crossflow,
    window_overlap,
    window_size,
)
from lidar_mi.retrieval.combined.grid_lines import (
    CHUNK_NUMBERS,
    GridLines,
    covariance_of_lines,
    covariance_with_nodes,
    crossflow_weights,
    line_spacing,
    lines_on_grid,
    with_slopes,
)
from lidar_mi.retrieval.combined.u_prior import (
    Statistics,
    correlation,
    probable_statistics,
    relative_std,
)
from lidar_mi.retrieval.combined.vectors import COMPONENTS, error_variables
from lidar_mi.retrieval.common_error import ROTATION
from lidar_mi.retrieval.threads import threads_for

# Prior standard deviation of the mean of u, m/s.
_MEAN_STD = 100.0


@threads_for(0)
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
    time: float | None = None,
    drift: tuple[float, float] = (0.0, 0.0),
    drift_std: tuple[float, float] = (0.0, 0.0),
) -> xr.Dataset:
    """The wind (u, v, w) on the images' grid from both lidars.

    Parameters
    ----------
    crossflow : xr.Dataset, dims (z, y)
        From `lidar_mi.retrieval.wind.pair.retrieve_wind`: `v`, `w`, `v_stderr`, `w_stderr`,
        `vw_correlation`, `flag`. Vectors are taken at the nodes. An error common to all of them
        (`lidar_mi.retrieval.common_error`) is an unknown of its own if it is ``free``; the lines
        determine it as far as they are oblique: a u that grows linearly over the plane looks the
        same.
    scan : xr.Dataset, dim line
        Line-of-sight velocities of the same air, as for
        `lidar_mi.retrieval.combined.vectors.wind_from_triples`, with `range_bin`. A line of sight
        averages the wind over its bin, along its oblique path through the (y, z) plane; the wind is
        taken to be uniform along x. Lines that leave the grid, or have no velocity, are not used.
    crossflow_std : float, optional
        Standard error of v and w, m/s, in place of the data set's own (methods that give none).
    window : float, optional
        Size of the windows, m, over which errors of v and w are correlated: by the fraction by
        which two windows overlap. By default the data set's ``template`` in metres; 0: not
        correlated.
    u_std, u_length : float, optional
        Standard deviation of u about its mean, m/s, and its correlation length, m. Default:
        averaged over values of both, weighted by their posterior probability, from 0.05 to 10 m/s
        (uniform prior) and from 1/4 of the lines' spacing to twice their extent (uniform prior of
        the logarithm).
    u_power : float, optional
        u's standard deviation is proportional to this power of the local shear of v and w, with
        the rms ``u_std`` over the lines; 0: uniform. Default: averaged over 0, 0.5 and 1 likewise.
    u_exponent : float, optional
        a of u's correlation, exp(-(|dy|^a + |dz|^a) / length^a), above 0 and up to 2: 1 is rough
        like turbulence, 2 smooth. Default: averaged over 1 and 2 likewise.
    distance : float, optional
        Of the images' plane x = const from the telescope, m: air that moves along x by dx relative
        to the gates shifts by -y / distance dx, -z / distance dx in the images, since beams are
        oblique. Default: no such shift, as for air that is uniform along x.
    gate_speed : float
        Of the images' gates over the ground along x, m/s; matters with ``distance``.
    time : float, optional
        That the wind is stated for, s, from the zero of the `time` of vectors and lines (the first
        image's reference time). Default: the mean of the valid vectors.
    drift : (float, float)
        Of the wind's pattern along y and z, m/s: vectors and lines of other times are moved by it
        to `time`, see `common_time.at_common_time`. Exact for a pattern that is frozen and drifts
        uniformly, except for the splines that read vectors between nodes (0.02 m/s in a core of
        three nodes). A drift that is wrong by dc leaves an error of |time - t| dc times the wind's
        gradient: 0.1 m/s for 1 m/s, 50 ms and 2 /s. 0: a steady wind, to which all times are one.
    drift_std : (float, float)
        Standard errors of `drift`, m/s, see `common_time.estimated_drift`. They enter those of
        vectors (not with ``crossflow_std``) and lines.

    Returns
    -------
    xr.Dataset, dims (z, y)
        `u`, `v`, `w` (m s-1), their standard errors and correlations, `flag` (bits of
        `CombinedFlag`). Where the images gave no vector, v and w are NaN, and lines have less
        weight: there v and w are assumed to be the mean of the others, with twice their standard
        deviation. Attributes: `lines_used`, `misfit` (of the lines, 1 where errors are as stated),
        and `u_std`, `u_length`, `u_power` and `u_exponent` of largest evidence. With a common error
        of v and w `v_common_stderr`, `w_common_stderr`, its standard error now, and if it was
        estimated `v_offset`, `w_offset` (m s-1), subtracted from all vectors of the images. `time`
        is that of the wind (s), where vectors have times; the attribute `drift` (m s-1) is as used.

    Raises
    ------
    InputError
        No valid vector, no line on the grid, an error that is not known.

    Notes
    -----
    With x the wind at all nodes, the background x_b of covariance P (v, w of the images with their
    errors; u by its statistics, of unknown mean) and the lines' velocities b = H x + e, e of
    variance R,

        x = x_b + P H^T S^-1 (b - H x_b),   S = H P H^T + R,   P_x = P - P H^T S^-1 H P .

    A line through nodes of valid v and w determines u there, and v and w a little better. The
    standard errors are as valid as those of v, w and v_LOS; they do not include errors of attitude
    or pointing beyond ``v_los_std``. Those of u assume that its variance is uniform, or larger
    where the shear of v and w is; between lines they depend on the statistics estimated from the
    lines. Over an ensemble of flows 71 % of the errors of u lie within one standard error and
    94 % within 1.96 (test_combine_ensemble.py). Where u is half the noise of
    a line it is 60 and 84 %; where u is smooth over the lines' spacing, or near zero but for a few
    jets, 80 to 90 and 97 %.
    """
    if time is None and "time" in crossflow:
        # variables, as with coordinates this takes ten times as long
        times, flags = (crossflow.variables[name] for name in ("time", "flag"))
        time = float(times.where(flags == 0).mean())
    crossflow, scan = at_common_time(
        crossflow, scan, 0.0 if time is None else time, drift, drift_std
    )
    field = checked_crossflow(crossflow, crossflow_std)
    z, y = (crossflow[axis].values.astype(float) for axis in ("z", "y"))
    lines, middles = lines_on_grid(scan, z, y)
    slope = apparent_slopes(z, y, distance)
    # v and w for u = 0: what images show are those for u = gate_speed. `forward` has the lines' u
    field = field._replace(value=field.value - gate_speed * slope)
    lines = with_slopes(lines, slope)
    if window is None:
        window = window_size(crossflow)
    elif not window >= 0:
        raise InputError(f"window: {window} m is not allowed; expected >= 0 m")
    overlap = window_overlap(z, window), window_overlap(y, window)

    forward, across = lines.forward.sum(1), lines.direction[:, 1:]
    mean = np.einsum("lk,lkc->lc", lines.weight, field.value[lines.z, lines.y])
    # of the notes above: residual is b - H x_b, covariance_without_u is S but for the part of u
    residual = lines.along - (across * mean).sum(1)
    without_image = (lines.weight * ~field.valid[lines.z, lines.y]).sum(1)
    covariance_without_u = lines.covariance + np.diag(
        without_image**2 * (across**2 @ field.prior_std**2)
    )
    # the mean of u is unknown: a prior so wide that it has no weight
    covariance_without_u += _MEAN_STD**2 * np.outer(forward, forward)
    covariance_without_u += covariance_of_lines(
        lines, crossflow_weights(field, lines), *overlap
    ).sum(0)
    # the lines' velocities per m/s of an error that all vectors share
    shared = across * lines.weight.sum(1, keepdims=True)
    if field.estimated:
        covariance_without_u += (shared * field.common**2) @ shared.T

    spacing = line_spacing(lines, z, y)
    relative_stds = relative_std(field, lines, z, y, spacing, u_power)
    known = u_std, u_length, u_exponent
    drawn, best = probable_statistics(
        covariance_without_u, residual, lines, z, y, spacing, relative_stds, known
    )
    valid = field.valid
    wind = np.zeros((*valid.shape, 3))
    covariance = np.zeros((*valid.shape, 3, 3))
    # in chunks of rows: the covariance of nodes and lines would fill the memory
    rows = max(1, int(CHUNK_NUMBERS / (3 * len(residual) * len(y))))
    for start in range(0, len(z), rows):
        chunk = slice(start, start + rows)
        wind[chunk], covariance[chunk] = _posterior(
            chunk, field, lines, overlap, drawn, relative_stds, residual, shared, z, y
        )
    wind[..., 1:] += slope * wind[..., :1]
    # of (u, v, w) by u and by v and w for u = 0
    jacobian = np.zeros((*valid.shape, 3, 3)) + np.eye(3)
    jacobian[..., 1:, 0] = slope
    covariance = jacobian @ covariance @ jacobian.swapaxes(-1, -2)
    wind[~valid, 1:] = np.nan
    covariance[~valid, 1:] = covariance[~valid, :, 1:] = np.nan
    flag = CombinedFlag.NO_CROSSFLOW * ~valid + CombinedFlag.BEYOND_LINES * ~_inside(middles, z, y)
    attributes: dict[str, Any] = {
        "lines_used": len(residual),
        "misfit": best.misfit,
        "u_std": best.std,
        "u_length": best.length,
        "u_power": best.power,
        "u_exponent": best.exponent,
        "window": window,
    }
    at: dict[str, Any] = {}
    if time is not None:
        about = {"long_name": "time of the wind from the first image's", "units": "s"}
        at["time"] = (), time, about
        attributes |= {"drift": list(drift), "drift_std": list(drift_std), "drift_units": "m s-1"}
    combined = _dataset(crossflow, wind, covariance, flag, at, attributes)
    if ROTATION in crossflow:
        combined[ROTATION] = crossflow[ROTATION]
    if field.common.any():
        combined = _with_common(combined, field, *_common(field, drawn, residual, shared))
    return combined


def _with_common(
    combined: xr.Dataset, field: Crossflow, offset: np.ndarray, stderr: np.ndarray
) -> xr.Dataset:
    """The data set with the error common to the images' vectors, after its correction."""
    for index, name in enumerate(COMPONENTS[1:]):
        about = {"long_name": f"part of {name}_stderr that all vectors share", "units": "m s-1"}
        combined[f"{name}_common_stderr"] = (), stderr[index], about
        if field.estimated:
            about = {"long_name": f"error of {name} common to all of the images", "units": "m s-1"}
            combined[f"{name}_offset"] = (), offset[index], about
    return combined


def _posterior(
    rows: slice,
    field: Crossflow,
    lines: GridLines,
    overlap: tuple[np.ndarray, np.ndarray],
    choices: Sequence[Statistics],
    relative_stds: Mapping[float, np.ndarray],
    residual: np.ndarray,
    shared: np.ndarray,
    z: np.ndarray,
    y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Wind (z, y, 3) and covariance (z, y, 3, 3) at the nodes of some rows."""
    root = field.root[rows]
    vw_with_lines = covariance_with_nodes(rows, lines, crossflow_weights(field, lines), *overlap)
    vw_with_lines = np.einsum("zyab,bzyl->azyl", root, vw_with_lines)
    vw_covariance = np.einsum("zyab,zycb->zyac", root, root)
    if field.estimated:
        vw_with_lines = vw_with_lines + (field.common**2 * shared).T[:, None, None, :]
        vw_covariance = vw_covariance + np.diag(field.common**2)
    shape = vw_covariance.shape[:2]
    wind, covariance = np.zeros((len(choices), *shape, 3)), np.zeros((*shape, 3, 3))
    inverse = np.zeros((len(residual), len(residual)))
    probability = np.array([choice.probability for choice in choices])
    for number, choice in enumerate(choices):
        correlations = [correlation(axis, choice.length, choice.exponent) for axis in (z, y)]
        strength = choice.std * relative_stds[choice.power]
        weight = (lines.forward * strength[lines.z, lines.y])[..., None]
        (along,) = strength[rows, :, None] * covariance_with_nodes(
            rows, lines, weight, *correlations
        )
        along = _MEAN_STD**2 * lines.forward.sum(1) + along
        # the variance of u is the difference of much larger numbers: not by the inverse of S
        whitened = choice.white @ along.reshape(-1, len(residual)).T
        gain = (whitened.T @ choice.white).reshape(along.shape)
        weighted = choice.white.T @ (choice.white @ np.column_stack([residual, shared]))
        wind[number, ..., 0] = gain @ residual
        wind[number, ..., 1:] = field.value[rows] + np.moveaxis(
            vw_with_lines @ weighted[:, 0], 0, -1
        )
        explained = (whitened**2).sum(0).reshape(shape)
        mixed = -np.einsum("zyl,azyl->zya", gain, vw_with_lines)
        covariance[..., 0, 0] += choice.probability * (
            _MEAN_STD**2 + strength[rows] ** 2 - explained
        )
        covariance[..., 0, 1:] += choice.probability * mixed
        covariance[..., 1:, 0] += choice.probability * mixed
        inverse += choice.probability * choice.white.T @ choice.white
        if field.common.any() and not field.estimated:
            # an error that the estimate does not allow for (Schmidt 1966)
            response = np.concatenate([(gain @ shared)[None], vw_with_lines @ weighted[:, 1:]])
            effect = np.eye(3)[:, 1:] - np.moveaxis(response, 0, -2)
            covariance += choice.probability * (effect * field.common**2) @ effect.swapaxes(-1, -2)
    # mixture of the choices: mean of their covariances, plus the scatter of their means
    covariance[..., 1:, 1:] += vw_covariance - np.einsum(
        "azyl,bzyl->zyab", vw_with_lines @ inverse, vw_with_lines
    )
    mean = np.tensordot(probability, wind, 1)
    off = wind - mean
    return mean, covariance + np.einsum("n,nzya,nzyb->zyab", probability, off, off)


def _common(
    field: Crossflow, choices: Sequence[Statistics], residual: np.ndarray, shared: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The error (2,) common to all vectors of the images, and its standard error, m/s."""
    if not field.estimated:
        return np.zeros(2), field.common
    means, squares = [], []
    for choice in choices:
        response, data = (choice.white @ part for part in (shared, residual))
        gain = field.common[:, None] ** 2 * response.T
        means.append(-gain @ data)
        squares.append(field.common**2 - (gain @ response).diagonal() * field.common**2)
    probability = np.array([choice.probability for choice in choices])
    mean = probability @ means
    return mean, np.sqrt(probability @ (np.array(squares) + (np.array(means) - mean) ** 2))


def _inside(middles: np.ndarray, z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether nodes lie among the lines, (z, y)."""
    places = np.stack(np.meshgrid(y, z), -1)
    try:
        sides = scipy.spatial.ConvexHull(middles).equations
    except (scipy.spatial.QhullError, ValueError):  # lines in a row, or fewer than three
        return np.zeros(places.shape[:2], bool)
    # distances beyond the sides, m
    return (places @ sides[:, :2].T + sides[:, 2] <= 1e-9).all(-1)


def _dataset(
    crossflow: xr.Dataset,
    wind: np.ndarray,
    covariance: np.ndarray,
    flag: np.ndarray,
    at: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> xr.Dataset:
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
            "flag": (dims, flag.astype(np.uint16), flag_attributes(CombinedFlag, REJECTED)),
            **at,
        },
        coords={axis: crossflow.variables[axis] for axis in dims},
        attrs={
            "Conventions": "CF-1.11",
            "title": "Wind from a Doppler and a backscatter lidar",
            **attributes,
            "u_std_units": "m s-1",
            "u_length_units": "m",
            "window_units": "m",
        },
    )
