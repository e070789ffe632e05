"""An error that all vectors of an image pair have in common: unknown pointing between the scans.

If the second scan points off by a small angle in pitch or yaw, its image is displaced as a whole,
by range times angle, and every vector errs by that displacement over the time between the scans.
An unknown roll rotates the image: the error grows with the distance from the axis of the roll.
"""

from typing import Literal

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError

NAMES = ("v_common_stderr", "w_common_stderr")
"""Variables of a data set of vectors that state it, m/s."""
ROTATION = "rotation_common_stderr"
"""The same of a rotation, rad/s, with the attributes `centre_y` and `centre_z`, m."""
# Least fraction of a stated error that is independent of the other vectors'.
_LEAST_INDEPENDENT = 1e-3


def with_common_error(
    wind: xr.Dataset,
    stderr: float,
    offset: Literal["known", "free"] = "known",
    rotation: float = 0.0,
    centre: tuple[float, float] = (0.0, 0.0),
) -> xr.Dataset:
    """Vectors whose stated errors include one that is common to all of them.

    wind: from `lidar_mi.retrieval.wind.pair.retrieve_wind`.
    stderr: of v and of w, m/s: the standard error of the pointing between the scans (rad) times the
        range over the time between the scans.
    offset {"known", "free"}: whether a combination with other measurements may estimate the common
        error (free) or only states it.
    rotation: standard error of the image's rotation about ``centre`` (y, z in m), rad/s: that of
        the roll between the scans (rad) over the time between them.

    Raises InputError: an error that is not a number of 0 or more.

    Returns
    -------
    xr.Dataset
        With `v_common_stderr` and `w_common_stderr` (m s-1) and `rotation_common_stderr` (rad s-1),
        which are part of `v_stderr` and `w_stderr`, the correlation of both, and the errors of a
        fitted pair; attribute ``pointing_offset``.
    """
    for name, value, units in (("stderr", stderr, "m/s"), ("rotation", rotation, "rad/s")):
        if not 0 <= value < np.inf:
            raise InputError(f"{name}: {value!r} {units} is not allowed; expected a number >= 0")
    widened = wind.copy()
    first, second = wind["v_stderr"], wind["w_stderr"]
    arms = [
        (wind[f"{axis}_vector"] if f"{axis}_vector" in wind else wind[axis]) - middle
        for axis, middle in zip("yz", centre, strict=True)
    ]
    turned = {"v_stderr": -rotation * arms[1], "w_stderr": rotation * arms[0]}
    for name in turned:
        total = _hypot(_hypot(wind[name], stderr), turned[name])
        widened[name] = _like(total, wind[name])
    for name in map(str, wind.data_vars):
        of_pair = name.endswith("_stderr") and _PER_ROTATION in wind[name].attrs
        if of_pair or name in _OF_A_PAIR:
            part = wind[name].attrs.get(_PER_ROTATION, 0.0) + _moved(name, centre)
            shared = stderr if name in _OF_A_PAIR else 0.0
            total = _hypot(_hypot(wind[name], shared), rotation * part)
            widened[name] = _like(total, wind[name])
    larger = widened["v_stderr"] * widened["w_stderr"]
    product = wind["vw_correlation"] * first * second + turned["v_stderr"] * turned["w_stderr"]
    correlation = (product / larger.where(larger > 0)).where(larger != 0, 0.0)
    widened["vw_correlation"] = _like(correlation, wind["vw_correlation"])
    for name in NAMES:
        about = {"long_name": f"part of {name[0]}_stderr that all vectors share", "units": "m s-1"}
        widened[name] = (), float(stderr), about
    turning: dict[str, str | float] = {
        "long_name": "part of v_stderr and w_stderr that is a rotation of all vectors",
        "units": "rad s-1",
        "centre_y": float(centre[0]),
        "centre_z": float(centre[1]),
    }
    widened[ROTATION] = (), float(rotation), turning
    return widened.assign_attrs(pointing_offset=str(offset))


def _hypot(a: xr.DataArray, b: xr.DataArray | float) -> xr.DataArray:
    return xr.apply_ufunc(np.hypot, a, b)


def _like(values: xr.DataArray, like: xr.DataArray) -> xr.DataArray:
    """Values with the type, order of dims and attributes of another field."""
    return values.transpose(*like.dims).astype(like.dtype).assign_attrs(like.attrs)


def _moved(name: str, centre: tuple[float, float]) -> float:
    """Change of a pair's mean wind or drift by the rotation's centre, m/s per rad/s."""
    if name not in _OF_A_PAIR:
        return 0.0
    return centre[1] if "_v_" in name else -centre[0]


# Attribute of a fitted pair's standard errors, see `Quantity`.
_PER_ROTATION = "per_rotation"
_OF_A_PAIR = ("mean_v_stderr", "mean_w_stderr", "drift_v_stderr", "drift_w_stderr")


def common_stderr(wind: xr.Dataset) -> np.ndarray:
    """Standard errors of v and w (2,), m/s, that all vectors share; 0 where none is stated."""
    return np.array([float(wind[name]) if name in wind else 0.0 for name in NAMES])


def common_rotation(wind: xr.Dataset) -> tuple[float, tuple[float, float]]:
    """Standard error of the rotation of all vectors, rad/s, and its centre y, z, m."""
    if ROTATION not in wind:
        return 0.0, (0.0, 0.0)
    about = wind[ROTATION].attrs
    return float(wind[ROTATION]), (about.get("centre_y", 0.0), about.get("centre_z", 0.0))


def own_errors(
    stderr: np.ndarray, correlation: np.ndarray, common: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (2, ...) of v and w without the common ones (2,), and their correlation."""
    if not common.any():
        return stderr, correlation
    part = np.reshape(common, (2, *[1] * (stderr.ndim - 1)))
    independent = np.sqrt(np.maximum(stderr**2 - part**2, (_LEAST_INDEPENDENT * stderr) ** 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = correlation * stderr.prod(0) / independent.prod(0)
    return independent, np.clip(scaled, -0.999, 0.999)
