"""Vectors and lines of sight of different times, brought to one.

The images' vectors belong to times about the middle of both scans, the lines of the Doppler lidar
to their own. Meanwhile the pattern of the wind drifts on: vortices move with the mean wind and with
the flow that each induces on the other, turbulence with the mean wind (Taylor 1938).
"""

from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.combined.crossflow import window_overlap, window_size
from lidar_mi.retrieval.combined.vectors import line_origins, line_places
from lidar_mi.retrieval.images.common_grid import nearest_filled

# Nodes by which a place may lie outside of the grid by rounding.
_ROUNDING = 1e-9
_FIELDS = ("v", "w", "v_stderr", "w_stderr", "vw_correlation")


class Drift(NamedTuple):
    """Velocity along y and z of a pattern, and its standard errors, m/s."""

    velocity: tuple[float, float]
    std: tuple[float, float]


def estimated_drift(crossflow: xr.Dataset, crossflow_std: float | None = None) -> Drift:
    """Velocity (v, w) with which the pattern of the wind drifts, from the wind itself.

    Vorticity moves with the air (Helmholtz). The drift is the mean of v and w, weighted with the
    square of the vorticity, over valid vectors:

        c = sum omega^2 (v, w) / sum omega^2 ,   omega = dw/dy - dv/dz .

    The swirl of a vortex itself cancels. The mean wind and the induction by the others remain. It
    is exact for round vortices of equal strength far from each other and from the edge; for a pair
    20 to 47 m apart with cores of 3 m on nodes of 1 to 2 m the descent is right to 1 %. Of vortices
    that drift at different velocities it is the mean.

    The standard errors are the larger of two: the propagated errors of the vectors, correlated as
    their windows overlap; and the scatter of the drift within the pattern,
    from the difference between vorticity of either sign, which has these errors as well. Noise also
    gives vorticity to air outside the vortices; its effect on c is added.

    crossflow (z, y): as for `lidar_mi.retrieval.combined.combine.combine`.
    crossflow_std: standard error of v and w, m/s, in place of the data set's own.

    Raises InputError: fewer than three valid vectors side by side.
    """
    valid = (crossflow["flag"] == 0).transpose("z", "y").values
    v, w = (crossflow[n].transpose("z", "y").values.astype(float) for n in ("v", "w"))
    z, y = (crossflow[axis].values.astype(float) for axis in ("z", "y"))
    v, w = (np.where(valid, part, np.nan) for part in (v, w))
    vorticity = np.zeros_like(v)
    if min(v.shape) >= 3:
        vorticity = np.gradient(w, y, axis=1) - np.gradient(v, z, axis=0)
    known = np.isfinite(vorticity) & np.isfinite(v) & np.isfinite(w)
    vorticity, v, w = (np.where(known, part, 0.0) for part in (vorticity, v, w))
    total = float((vorticity**2).sum())
    if not total > 0:
        raise InputError(
            "crossflow: no vorticity is known, as no three valid vectors lie side by side; "
            "expected a drift in m/s"
        )
    drift = [float((vorticity**2 * part).sum()) / total for part in (v, w)]
    by_z, by_y = (np.asarray(np.gradient(np.eye(len(axis)), axis, axis=0)) for axis in (z, y))
    errors = _errors(crossflow, crossflow_std)
    # variance of the vorticity by errors of the vectors
    noise = known * (
        _of_differences(by_y, errors.along_y) * errors.w**2
        + _of_differences(by_z, errors.along_z)[:, None] * errors.v**2
    )
    variances = []
    for part, mean, (of_v, of_w) in zip((v, w), drift, ((1, 0), (0, 1)), strict=True):
        # derivatives of the drift by the vorticity, and by v and w of every vector
        by_vorticity = 2 * vorticity * (part - mean) / total
        direct = vorticity**2 / total
        by_v, by_w = direct * of_v - by_z.T @ by_vorticity, direct * of_w + by_vorticity @ by_y
        by_noise = _of_vectors(errors, by_v, by_w)
        bias = float((noise * (part - mean)).sum()) / total
        variances.append(max(by_noise, _between_signs(vorticity, part)) + bias**2)
    stderr = [float(np.sqrt(part)) for part in variances]
    return Drift((drift[0], drift[1]), (stderr[0], stderr[1]))


def _between_signs(vorticity: np.ndarray, part: np.ndarray) -> float:
    """Variance of the drift between vorticity of either sign, of one component of the wind."""
    square = vorticity**2 / (vorticity**2).sum()
    signs = vorticity > 0, vorticity < 0
    weights = [float(square[sign].sum()) for sign in signs]
    if not min(weights) > 0:
        return 0.0
    means = [
        float((square * part)[sign].sum()) / weight
        for sign, weight in zip(signs, weights, strict=True)
    ]
    return weights[0] * weights[1] * (means[0] - means[1]) ** 2


class _Errors(NamedTuple):
    """Errors of v and w (z, y), m/s, their correlation, and that along both axes, (n, n)."""

    v: np.ndarray
    w: np.ndarray
    together: np.ndarray
    along_z: np.ndarray
    along_y: np.ndarray


def _errors(crossflow: xr.Dataset, std: float | None) -> _Errors:
    shape = crossflow.sizes["z"], crossflow.sizes["y"]
    if std is None:
        stated = [
            np.nan_to_num(crossflow[name].transpose("z", "y").values.astype(float))
            if name in crossflow
            else np.zeros(shape)
            for name in ("v_stderr", "w_stderr", "vw_correlation")
        ]
    else:
        stated = [np.full(shape, part) for part in (std, std, 0.0)]
    window = window_size(crossflow)
    along = [window_overlap(crossflow[axis].values.astype(float), window) for axis in ("z", "y")]
    return _Errors(*stated, *along)


def _of_differences(slope: np.ndarray, overlap: np.ndarray) -> np.ndarray:
    """Variance (n,) of a derivative along an axis by errors of variance 1."""
    return (slope * (slope @ overlap)).sum(1)


def _of_vectors(errors: _Errors, by_v: np.ndarray, by_w: np.ndarray) -> float:
    """Variance of a sum of vectors with the factors by_v and by_w, dims (z, y)."""
    # Cholesky factors of the errors of v and w
    independent = np.sqrt(np.clip(1 - errors.together**2, 0, 1))
    parts = (by_v * errors.v + by_w * errors.w * errors.together, by_w * errors.w * independent)
    return float(sum((part * (errors.along_z @ part @ errors.along_y)).sum() for part in parts))


def at_common_time(
    crossflow: xr.Dataset,
    scan: xr.Dataset,
    time: float,
    drift: tuple[float, float],
    drift_std: tuple[float, float] = (0.0, 0.0),
) -> tuple[xr.Dataset, xr.Dataset]:
    """Vectors and lines of sight as they were at one time, of a pattern that drifts.

    The pattern at x at the time t is at x + c (time - t). Lines of sight start elsewhere. Vectors
    are read between the nodes by cubic splines; their standard errors, which
    correlate as windows overlap, linearly.

    crossflow (z, y): with `time`, s, of every vector.
    scan (line): with `time`, s, of every line, from the same zero; absent: 0 for all.
    time: s
    drift: c along y and z, m/s.
    drift_std: its standard errors, m/s. Times time - t and the gradient of the wind they are an
        error of every vector and line, which is added to the stated ones in quadrature.

    Raises InputError: numbers that are not finite, vectors without times.

    Returns
    -------
    crossflow, scan : xr.Dataset
        Vectors that come from beyond the images, or from next to flagged ones, are flagged.
    """
    if not any(drift) and not any(drift_std):
        return crossflow, scan
    for name, number in (("time", time), ("drift", drift), ("drift_std", drift_std)):
        if not np.isfinite(number).all():
            raise InputError(f"{name}: {number} is not allowed; expected finite numbers")
    if "time" not in crossflow or set(crossflow["time"].dims) != {"z", "y"}:
        raise InputError("crossflow.time: missing; expected the time of every vector, s")
    blurred = _blurred(crossflow, scan, time, drift_std) if any(drift_std) else (crossflow, scan)
    return _vectors(blurred[0], time, drift), _lines(blurred[1], time, drift)


def _blurred(
    crossflow: xr.Dataset, scan: xr.Dataset, time: float, drift_std: tuple[float, float]
) -> tuple[xr.Dataset, xr.Dataset]:
    """Vectors and lines whose standard errors contain that of the drift."""
    flow = crossflow.transpose(..., "z", "y")
    z, y = (flow[axis].values.astype(float) for axis in ("z", "y"))
    valid = flow["flag"].values == 0
    # of v and w, by y and z
    slopes = []
    for name in ("v", "w"):
        filled = nearest_filled(np.where(valid, flow[name].values.astype(float), np.nan))
        slopes.append(np.stack([np.gradient(filled, y, axis=1), np.gradient(filled, z, axis=0)]))
    moved = np.reshape(drift_std, (2, 1, 1)) * (time - nearest_filled(flow["time"].values))
    stated = {}
    for name, slope in zip(("v_stderr", "w_stderr"), slopes, strict=True):
        if name in flow:
            off = np.sqrt(((slope * moved) ** 2).sum(0))
            stated[name] = flow[name].copy(data=np.hypot(flow[name].values, off))
    when = scan["time"].values if "time" in scan else np.zeros(scan.sizes["line"])
    places = line_places(scan)
    nodes = [
        (places[:, 2] - z[0]) / (np.ptp(z) / (len(z) - 1)),
        (places[:, 1] - y[0]) / (np.ptp(y) / (len(y) - 1)),
    ]
    across = scan["direction"].transpose("line", "axis").values[:, 1:]
    of_lines = np.zeros((2, len(when)))
    for factor, slope in zip(across.T, slopes, strict=True):
        for axis in range(2):
            of_lines[axis] += factor * scipy.ndimage.map_coordinates(
                slope[axis], nodes, order=1, mode="nearest"
            )
    off = np.sqrt(((of_lines * np.reshape(drift_std, (2, 1)) * (time - when)) ** 2).sum(0))
    std = scan["v_los_std"]
    return flow.assign(stated), scan.assign(v_los_std=std.copy(data=np.hypot(std.values, off)))


def _lines(scan: xr.Dataset, time: float, drift: tuple[float, float]) -> xr.Dataset:
    when = scan["time"].values if "time" in scan else np.zeros(scan.sizes["line"])
    along = np.concatenate([[0.0], drift])
    return scan.assign(
        origin=(("line", "axis"), line_origins(scan) + (time - when[:, None]) * along)
    )


def _vectors(crossflow: xr.Dataset, time: float, drift: tuple[float, float]) -> xr.Dataset:
    flow = crossflow.transpose(..., "z", "y")
    steps = [float(np.diff(flow[axis].values).mean()) for axis in ("z", "y")]
    # nodes per second along z and y
    speed = np.array([drift[1] / steps[0], drift[0] / steps[1]])
    when = nearest_filled(flow["time"].values.astype(float))
    nodes = np.indices(when.shape).astype(float)
    # times vary slowly over the displacement: two iterations are enough
    source = nodes - speed[:, None, None] * (time - when)
    source = nodes - speed[:, None, None] * (
        time - scipy.ndimage.map_coordinates(when, source, order=1, mode="nearest")
    )
    valid = (flow["flag"].values == 0) & np.isfinite(flow["v"].values + flow["w"].values)
    ends = np.reshape([n - 1 for n in when.shape], (2, 1, 1))
    inside = ((source > -_ROUNDING) & (source < ends + _ROUNDING)).all(0)
    around = scipy.ndimage.map_coordinates(valid.astype(float), source, order=1, mode="nearest")
    known = inside & (around > 1 - _ROUNDING)
    fields = {}
    for name in (name for name in _FIELDS if name in flow):
        filled = nearest_filled(np.where(valid, flow[name].values.astype(float), np.nan))
        order = 3 if name in ("v", "w") else 1
        moved = scipy.ndimage.map_coordinates(filled, source, order=order, mode="nearest")
        fields[name] = flow[name].copy(data=np.where(known, moved, np.nan))
    flag = flow["flag"]
    fields["flag"] = flag.copy(data=np.where(known, 0, np.maximum(flag.values, 1)))
    fields["time"] = flow["time"].copy(data=np.full(when.shape, float(time)))
    return flow.assign(fields)
