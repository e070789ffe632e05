"""An error that all vectors of an image pair have in common: unknown pointing between the scans.

If the second scan points off by a small angle in pitch or yaw, its image is displaced as a whole,
by range times angle, and every vector errs by that displacement over the time between the scans.
"""

from typing import Literal

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError

NAMES = ("v_common_stderr", "w_common_stderr")
"""Variables of a data set of vectors that state it, m/s."""
# Least fraction of a stated error that is the vector's own.
_LEAST_OWN = 1e-3


def with_common_error(
    wind: xr.Dataset, stderr: float, offset: Literal["known", "free"] = "known"
) -> xr.Dataset:
    """Vectors whose stated errors include one that is common to all of them.

    Parameters
    ----------
    wind : xr.Dataset
        From `lidar_mi.retrieval.velocimetry.wind.retrieve_wind`.
    stderr : float
        Of v and of w, m/s: the standard error of the pointing between the scans (rad) times the
        range over the time between the scans.
    offset : {"known", "free"}
        Whether a combination with other measurements may estimate the common error (free) or only
        states it.

    Returns
    -------
    xr.Dataset
        With `v_common_stderr` and `w_common_stderr` (m s-1), which are part of `v_stderr` and
        `w_stderr`, the correlation of both, and the errors of a fitted pair's mean wind and drift;
        attribute ``pointing_offset``.

    Raises
    ------
    InputError
        An error that is not a number of 0 or more.
    """
    if not 0 <= stderr < np.inf:
        raise InputError(f"stderr: {stderr!r} m/s is not allowed; expected a number >= 0")
    found = wind.copy()
    first, second = wind["v_stderr"], wind["w_stderr"]
    for name in ("v_stderr", "w_stderr", *_OF_A_PAIR):
        if name in wind:
            both = np.hypot(wind[name], stderr).astype(wind[name].dtype)
            found[name] = both.assign_attrs(wind[name].attrs)
    larger = found["v_stderr"] * found["w_stderr"]
    ratio = (first * second / larger.where(larger > 0)).where(larger != 0, 0.0)
    correlation = wind["vw_correlation"]
    found["vw_correlation"] = (
        (correlation * ratio).astype(correlation.dtype).assign_attrs(correlation.attrs)
    )
    for name in NAMES:
        about = {"long_name": f"part of {name[0]}_stderr that all vectors share", "units": "m s-1"}
        found[name] = (), float(stderr), about
    return found.assign_attrs(pointing_offset=str(offset))


_OF_A_PAIR = ("mean_v_stderr", "mean_w_stderr", "drift_v_stderr", "drift_w_stderr")


def common_stderr(wind: xr.Dataset) -> np.ndarray:
    """Standard errors of v and w (2,), m/s, that all vectors share; 0 where none is stated."""
    return np.array([float(wind[name]) if name in wind else 0.0 for name in NAMES])


def own_errors(
    stderr: np.ndarray, correlation: np.ndarray, common: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (2, ...) of v and w without the common ones (2,), and their correlation."""
    if not common.any():
        return stderr, correlation
    part = np.reshape(common, (2, *[1] * (stderr.ndim - 1)))
    own = np.sqrt(np.maximum(stderr**2 - part**2, (_LEAST_OWN * stderr) ** 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = correlation * stderr.prod(0) / own.prod(0)
    return own, np.clip(scaled, -0.999, 0.999)
