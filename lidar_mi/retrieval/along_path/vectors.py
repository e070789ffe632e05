"""The independent vectors of a slab of air: those whose windows do not overlap."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import masks_of
from lidar_mi.retrieval.common_error import common_rotation, common_stderr

ACROSS = ("v", "w")
"""Components that every slab has."""

# Flag of vectors of which only u is rejected.
_ONLY_U = "beyond_lines"
# Least fraction of a stated error that is independent of the other vectors'.
_LEAST_INDEPENDENT = 1e-3


@dataclass(frozen=True, eq=False)
class SlabVectors:
    """v and w of a slab on a grid of windows that do not overlap.

    y, z (ndarray, shapes (ny,) and (nz,)): m.
    wind, stderr (2, nz, ny): v and w, and the independent part of their standard errors, m/s; NaN
        where rejected.
    window: size of the windows, m: errors are correlated over it.
    common (2,): standard error of v and w that all vectors of the slab share, m/s.
    rotation: standard error of a rotation of all vectors, rad/s.
    centre: y and z about which they turn, m.
    """

    y: np.ndarray
    z: np.ndarray
    wind: np.ndarray
    stderr: np.ndarray
    window: float
    common: np.ndarray
    rotation: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def valid(self) -> np.ndarray:
        """Whether both components are known, (nz, ny)."""
        return np.isfinite(self.wind).all(0)


def counting(wind: xr.Dataset) -> xr.Dataset:
    """The vectors whose windows do not overlap, as a data set of the same variables.

    Vectors between them add nearly no information, and their errors are not independent. `wind` is
    of `retrieve_wind` or `combine`; the result has an attribute `window` (m).

    Raises InputError: no standard errors, or windows of unknown size.
    """
    for name in ("v", "w", "v_stderr", "w_stderr", "flag"):
        if name not in wind:
            raise InputError(f"wind.{name}: missing; expected v, w, their errors and flag")
    window = _window(wind)
    separate = {name: _separate(wind.variables[name].values, window) for name in ("z", "y")}
    return wind.isel(separate).assign_attrs(window=window)


def slab_vectors(wind: xr.Dataset) -> SlabVectors:
    """Vectors of `counting`, with the common part of their errors stated separately."""
    y, z = (wind.variables[axis].values.astype(float) for axis in ("y", "z"))

    def values(name: str) -> np.ndarray:
        return wind.variables[name].transpose("z", "y").values.astype(float)

    components = np.stack([values(name) for name in ACROSS])
    stderr = np.stack([values(f"{name}_stderr") for name in ACROSS])
    common = common_stderr(wind)
    rotation, centre = common_rotation(wind)
    arms = np.stack(np.broadcast_arrays(z[:, None] - centre[1], y - centre[0]))
    shared = np.hypot(rotation * arms, np.reshape(common, (2, 1, 1)))
    independent = np.sqrt(np.maximum(stderr**2 - shared**2, (_LEAST_INDEPENDENT * stderr) ** 2))
    flag = values("flag").astype(int) & ~masks_of(wind["flag"].attrs).get(_ONLY_U, 0)
    good = (flag == 0) & (np.isfinite(components) & (stderr > 0) & np.isfinite(stderr)).all(0)
    known, errors = (np.where(good, array, np.nan) for array in (components, independent))
    return SlabVectors(y, z, known, errors, wind.attrs["window"], common, rotation, centre)


def _window(wind: xr.Dataset) -> float:
    """Size of the windows, m."""
    if "window" in wind.attrs:
        return float(wind.attrs["window"])
    try:
        pixels = wind.attrs["template"] / wind.attrs["stride"]
    except KeyError:
        raise InputError(
            "wind: attributes template and stride missing; expected those, or window in m"
        ) from None
    y = wind.variables["y"].values
    return float(pixels * (y[-1] - y[0]) / (len(y) - 1))


def _separate(axis: np.ndarray, window: float) -> np.ndarray:
    """Indices of nodes a window apart, one of them the nearest to the path."""
    step = max(1, round(window / (axis[1] - axis[0])))
    return np.arange(int(np.abs(axis).argmin()) % step, len(axis), step)
