"""Vectors and lines of sight of different times, brought to one.

The images' vectors belong to times about the middle of both scans, the lines of the Doppler lidar
to their own. Meanwhile the pattern of the wind drifts on: vortices move with the mean wind and with
the flow that each induces on the other, turbulence with the mean wind (Taylor 1938).
"""

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from lidar_mi.errors import InputError
from lidar_mi.retrieval.lines.vectors import line_origins
from lidar_mi.retrieval.velocimetry.common_grid import nearest_filled

# Nodes by which a place may lie outside of the grid by rounding.
_ROUNDING = 1e-9
_FIELDS = ("v", "w", "v_stderr", "w_stderr", "vw_correlation")


def estimated_drift(crossflow: xr.Dataset) -> tuple[float, float]:
    """Velocity (v, w), m/s, with which the pattern of the wind drifts, from the wind itself.

    Vorticity moves with the air (Helmholtz). The drift is the mean of v and w, weighted with the
    square of the vorticity, over valid vectors:

        c = sum omega^2 (v, w) / sum omega^2 ,   omega = dw/dy - dv/dz .

    Of a vortex its own swirl cancels, and what is left is the flow in which it is: the mean wind
    and what the others induce. Exact for round vortices of equal strength far from each other and
    from the edge; of a pair 20 to 47 m apart with cores of 3 m on nodes of 1 to 2 m the descent is
    right to 1 %. Where vortices drift by different velocities it is their mean.

    Raises
    ------
    InputError
        Fewer than three valid vectors side by side.
    """
    valid = (crossflow["flag"] == 0).transpose("z", "y").values
    v, w = (crossflow[n].transpose("z", "y").values.astype(float) for n in ("v", "w"))
    z, y = (crossflow[axis].values.astype(float) for axis in ("z", "y"))
    v, w = (np.where(valid, part, np.nan) for part in (v, w))
    weight = np.zeros_like(v)
    if min(v.shape) >= 3:
        weight = (np.gradient(w, y, axis=1) - np.gradient(v, z, axis=0)) ** 2
    known = np.isfinite(weight) & np.isfinite(v) & np.isfinite(w)
    total = float(weight[known].sum())
    if not total > 0:
        raise InputError(
            "crossflow: no vorticity is known, as no three valid vectors lie side by side; "
            "expected a drift in m/s"
        )
    along, up = (float((weight * part)[known].sum()) / total for part in (v, w))
    return along, up


def at_common_time(
    crossflow: xr.Dataset, scan: xr.Dataset, time: float, drift: tuple[float, float]
) -> tuple[xr.Dataset, xr.Dataset]:
    """Vectors and lines of sight as they were at one time, of a pattern that drifts.

    What was seen at x at the time t is at x + c (time - t). Lines of sight start elsewhere. Vectors
    are read between the nodes by cubic splines; their standard errors, which windows that overlap
    share, linearly.

    Parameters
    ----------
    crossflow : xr.Dataset, dims (z, y)
        With `time`, s, of every vector.
    scan : xr.Dataset, dim line
        With `time`, s, of every line, from the same zero; left out: 0 for all.
    time : float
        s
    drift : (float, float)
        c along y and z, m/s.

    Returns
    -------
    crossflow, scan : xr.Dataset
        Vectors that come from beyond the images, or from beside flagged ones, are flagged.

    Raises
    ------
    InputError
        Numbers that are not finite, vectors without times.
    """
    if not any(drift):
        return crossflow, scan
    for name, number in (("time", time), ("drift", drift)):
        if not np.isfinite(number).all():
            raise InputError(f"{name}: {number} is not allowed; expected finite numbers")
    if "time" not in crossflow or set(crossflow["time"].dims) != {"z", "y"}:
        raise InputError("crossflow.time: missing; expected the time of every vector, s")
    return _vectors(crossflow, time, drift), _lines(scan, time, drift)


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
    # times vary slowly over what the pattern moves: twice is enough
    source = nodes - speed[:, None, None] * (time - when)
    source = nodes - speed[:, None, None] * (
        time - map_coordinates(when, source, order=1, mode="nearest")
    )
    valid = (flow["flag"].values == 0) & np.isfinite(flow["v"].values + flow["w"].values)
    ends = np.reshape([n - 1 for n in when.shape], (2, 1, 1))
    inside = ((source > -_ROUNDING) & (source < ends + _ROUNDING)).all(0)
    around = map_coordinates(valid.astype(float), source, order=1, mode="nearest")
    seen = inside & (around > 1 - _ROUNDING)
    found = {}
    for name in (name for name in _FIELDS if name in flow):
        filled = nearest_filled(np.where(valid, flow[name].values.astype(float), np.nan))
        order = 3 if name in ("v", "w") else 1
        moved = map_coordinates(filled, source, order=order, mode="nearest")
        found[name] = flow[name].copy(data=np.where(seen, moved, np.nan))
    flag = flow["flag"]
    found["flag"] = flag.copy(data=np.where(seen, 0, np.maximum(flag.values, 1)))
    found["time"] = flow["time"].copy(data=np.full(when.shape, float(time)))
    return flow.assign(found)
