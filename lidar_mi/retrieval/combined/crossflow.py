"""Cross-flow wind of images, as it enters the combination of both lidars."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.checks import checked_image
from lidar_mi.retrieval.common_error import common_stderr, own_errors

# Standard deviation of v and w where the images gave no vector, over that of the valid ones:
# vectors are rejected where the wind varies most.
_PRIOR_WITHOUT_IMAGE = 2.0


class Crossflow(NamedTuple):
    """v and w of the images on the grid, arrays (z, y, ...).

    ``root`` is the Cholesky factor of the errors' covariance. Where a vector is not ``valid`` the
    value is the mean of the valid ones, with the standard deviation ``prior_std`` (2,). All share
    an error of standard deviation ``common`` (2,), which may be ``estimated`` or is only stated.
    """

    value: np.ndarray
    root: np.ndarray
    valid: np.ndarray
    prior_std: np.ndarray
    common: np.ndarray
    estimated: bool


def apparent_slopes(z: np.ndarray, y: np.ndarray, distance: float | None) -> np.ndarray:
    """Motion in the images per m/s of u relative to the gates, with the sign reversed, (z, y, 2).

    Oblique beams: air that moves along x by dx shifts by -(y, z) dx / distance in the images.
    """
    if distance is None:
        return np.zeros((len(z), len(y), 2))
    if not distance > 0:
        raise InputError(f"distance: {distance} m is not allowed; expected more than 0 m")
    return np.stack(np.meshgrid(y, z), -1) / distance


def checked_crossflow(wind: xr.Dataset, std: float | None) -> Crossflow:
    """v and w of a data set with the covariance of their errors, or with errors of ``std`` (m/s).

    With ``std``, vectors whose only flag is an unknown error are valid.

    Raises InputError: no valid vector, or an error that is not known.
    """
    for name in ("v", "w", "flag"):
        if name not in wind:
            raise InputError(f"crossflow.{name}: missing; expected v, w and flag on (z, y)")
        checked_image(f"crossflow.{name}", wind[name])
    value = np.stack([_values(wind, name) for name in ("v", "w")], -1)
    common = common_stderr(wind)
    if std is not None:
        if not std > 0:
            raise InputError(f"crossflow_std: {std} m/s is not allowed; expected more than 0 m/s")
        first = second = np.full(value.shape[:2], float(std))
        correlation = np.zeros_like(first)
    else:
        names = ("v_stderr", "w_stderr", "vw_correlation")
        if any(n not in wind or not np.isfinite(wind.variables[n].values).any() for n in names):
            method = wind.attrs.get("method", "unknown")
            raise InputError(
                f"crossflow.v_stderr: not known by method {method!r}; give crossflow_std"
            )
        *stderr, correlation = (_values(wind, name) for name in names)
        (first, second), correlation = own_errors(np.stack(stderr), correlation, common)
    flag = _values(wind, "flag").astype(int)
    # with a given crossflow_std, vectors of unknown error are valid
    allowed = 0 if std is None else Flag.ERROR_UNKNOWN.value
    valid = (flag & ~allowed == 0) & np.isfinite(value).all(-1)
    valid &= (first > 0) & (second > 0) & (abs(correlation) < 1)
    if not valid.any():
        raise InputError("crossflow.flag: every vector is flagged; expected some valid ones")
    root = np.zeros((*valid.shape, 2, 2))
    root[..., 0, 0] = first
    root[..., 1, 0] = correlation * second
    root[..., 1, 1] = np.sqrt(1 - correlation**2) * second
    root[~valid] = 0.0
    mean, prior_std = value[valid].mean(0), _PRIOR_WITHOUT_IMAGE * value[valid].std(0)
    value = np.where(valid[..., None], value, mean)
    free = bool(common.any()) and wind.attrs.get("pointing_offset") == "free"
    return Crossflow(value, root, valid, prior_std, common, free)


def _values(wind: xr.Dataset, name: str) -> np.ndarray:
    """Values of a variable (z, y), without coordinates, which take longest to attach."""
    return wind.variables[name].transpose("z", "y").values.astype(float)


def window_size(crossflow: xr.Dataset) -> float:
    """Size of the windows of a data set, m."""
    try:
        pixels = crossflow.attrs["template"] / crossflow.attrs["stride"]
    except KeyError:
        raise InputError(
            "crossflow: attributes template and stride missing; give window in m"
        ) from None
    return float(pixels * np.diff(crossflow["y"].values.astype(float)).mean())


def window_overlap(axis: np.ndarray, window: float) -> np.ndarray:
    """Fraction by which windows on the nodes of an axis overlap, (n, n)."""
    distance = abs(axis[:, None] - axis)
    if window == 0:
        return np.eye(len(axis))
    return np.clip(1 - distance / window, 0, None)
