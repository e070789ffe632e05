"""From two volumes to the wind in three dimensions: one call, CF data set out."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import on_device, positive
from lidar_mi.retrieval.velocimetry.quality import Flag, check_between
from lidar_mi.retrieval.velocimetry.volume_correlation import correlated
from lidar_mi.retrieval.velocimetry.volume_field import Volumes, prepared
from lidar_mi.retrieval.velocimetry.volume_variational import fitted_flow
from lidar_mi.retrieval.velocimetry.volume_windows import AXES, VolumeDisplacement, VolumeWindows

COMPONENTS = {"x": "u", "z": "w", "y": "v"}
"""Wind along each axis."""

_STANDARD_NAMES = {"u": "x_wind", "v": "y_wind", "w": "upward_air_velocity"}


def _correlation(images: Volumes, windows, spacing, min_correlation) -> VolumeDisplacement:
    return correlated(images, windows, min_correlation)


METHODS: Mapping[str, Callable[..., VolumeDisplacement]] = {
    "correlation": _correlation,
    "variational": fitted_flow,
}
"""(volumes, windows, spacing, min_correlation) -> VolumeDisplacement, by name."""


def retrieve_wind_volume(
    volume1: xr.DataArray,
    volume2: xr.DataArray,
    dt: float,
    method: str = "variational",
    template: int = 8,
    search: int = 16,
    stride: int = 4,
    device: str | torch.device = "cpu",
    *,
    more: Sequence[xr.DataArray] = (),
    min_correlation: float = 0.5,
    noise: float | xr.DataArray | None = None,
) -> xr.Dataset:
    """Wind in three dimensions from two volumes of the same air, dt apart.

    Parameters
    ----------
    volume1, volume2 : xr.DataArray, dims (x, z, y)
        On one grid: coordinates in metres (`units` attribute), ascending and uniform, spacings may
        differ from axis to axis; positive in the mean. Brightness may differ by a factor and by a
        decay along x. Non-finite voxels are left out.
    dt : float
        Time from volume to volume, s.
    method : {"correlation", "variational"}
        Correlation of deformed windows, or a smooth flow fitted to the volumes as a whole.
    template, search, stride : int
        Voxels: windows of template^3 (>= 4), displacements up to (search - template) / 2 in each
        direction, a vector every `stride`.
    device : str or torch.device
        Where to compute.
    more : sequence of xr.DataArray
        Further volumes, each dt after the one before ("variational" only).
    min_correlation : float
        Flag vectors whose volumes, carried to mid-time, correlate less over a window (variational:
        by less than half way from this to 1).
    noise : float or xr.DataArray, optional
        Standard deviation of a voxel's noise in volume 1, in its unit. Left out: from the spectra.

    Returns
    -------
    xr.Dataset, dims (x, z, y)
        At the windows' centres at mid-time: `u`, `v`, `w` and `u_stderr`, `v_stderr`, `w_stderr`
        (m s-1), `correlation`, `flag` (bits of `quality.Flag`, 0 = good; low texture means a
        standard error beyond half a voxel). Rejected vectors keep their value, or NaN where there
        is none.

    Raises
    ------
    InputError
        Volumes on different or unsuitable grids, thinner than a template, not bright; a parameter
        out of its range.

    Examples
    --------
    Air that moves by a voxel of 0.5 m along y in 0.1 s:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> air = 2 + gaussian_filter(np.random.default_rng(1).normal(size=(18, 18, 19)), 1.5)
    >>> axes = {d: (d, 0.5 * np.arange(18), {"units": "m"}) for d in "xzy"}
    >>> volume1, volume2 = (xr.DataArray(air[..., k : k + 18], axes, tuple("xzy")) for k in (1, 0))
    >>> wind = lm.retrieve_wind_volume(volume1, volume2, dt=0.1, method="correlation")
    >>> abs(float(wind["v"].median()) - 5) < 0.3
    True
    """
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    if more and method != "variational":
        raise InputError(f"more: {len(more)} volumes are not allowed with {method}; expected none")
    dt = positive("dt", dt)
    check_between("min_correlation", min_correlation, -1, 1)
    stack = [_checked(f"volume{n}", v) for n, v in enumerate((volume1, volume2, *more), 1)]
    for number, other in enumerate(stack[1:], 2):
        _same_grid(stack[0], other, f"volume{number}")
    if isinstance(noise, xr.DataArray):
        noise = _checked("noise", noise)
        _same_grid(stack[0], noise, "noise")
        noise = on_device(noise, device)
    windows = VolumeWindows(tuple(stack[0].shape), template, search, stride)
    images = prepared([on_device(volume, device) for volume in stack], noise)
    spacing = tuple(_spacing(stack[0], axis) for axis in AXES)
    found = METHODS[method](images, windows, spacing, min_correlation)
    settings = {
        "method": method,
        "template": template,
        "search": search,
        "stride": stride,
        "dt": dt,
        "min_correlation": min_correlation,
    }
    return _dataset(stack[0], windows, found, spacing, settings)


def _dataset(volume, windows, found: VolumeDisplacement, spacing, settings) -> xr.Dataset:
    dt, variables = settings["dt"], {}
    for number, axis in enumerate(AXES):
        name, scale = COMPONENTS[axis], spacing[number] / dt
        standard = _STANDARD_NAMES[name]
        variables[name] = _field(
            found.d[number] * scale, f"wind along {axis}", "m s-1", standard_name=standard
        )
        variables[f"{name}_stderr"] = _field(
            found.variance[number].sqrt() * scale,
            f"standard error of {name}",
            "m s-1",
            standard_name=f"{standard} standard_error",
        )
    variables["correlation"] = _field(
        found.score, "correlation of the volumes carried to mid-time", "1"
    )
    variables["flag"] = (
        AXES,
        found.flag.cpu().numpy(),
        {
            "long_name": "reasons to reject the vector, 0 = good",
            "standard_name": "quality_flag",
            "flag_masks": np.array([bit.value for bit in Flag], dtype=np.uint8),
            "flag_meanings": " ".join(bit.name.lower() for bit in Flag),
        },
    )
    about = {
        "x": {"long_name": "window centre, ahead", "axis": "X"},
        "z": {"long_name": "window centre, up", "axis": "Z", "positive": "up"},
        "y": {"long_name": "window centre, left", "axis": "Y"},
    }
    coords = {}
    for number, axis in enumerate(AXES):
        place = float(volume[axis][0]) + spacing[number] * windows.centres(number).numpy()
        coords[axis] = (axis, place, {"units": "m", **about[axis]})
    dataset = xr.Dataset(
        variables,
        coords,
        {"Conventions": "CF-1.11", "title": "Wind from two volumes", **settings, "dt_units": "s"},
    )
    for axis in AXES:
        dataset[axis].encoding["_FillValue"] = None
    return dataset[["u", "v", "w", "u_stderr", "v_stderr", "w_stderr", "correlation", "flag"]]


def _field(values: torch.Tensor, long_name: str, units: str, **more: str):
    attrs = {"long_name": long_name, "units": units, **more}
    return AXES, values.cpu().numpy().astype(np.float32), attrs


def _spacing(volume: xr.DataArray, axis: str) -> float:
    nodes = volume[axis].values.astype(float)
    return float((nodes[-1] - nodes[0]) / (len(nodes) - 1))


def _checked(name: str, volume: xr.DataArray) -> xr.DataArray:
    """The volume as (x, z, y), its grid known to be in metres, ascending and uniform."""
    if not isinstance(volume, xr.DataArray):
        raise InputError(f"{name}: {type(volume).__name__} is not an xarray.DataArray")
    if set(volume.dims) != set(AXES) or volume.ndim != 3:
        raise InputError(f"{name}: dims {tuple(volume.dims)} are not ('x', 'z', 'y')")
    if volume.dtype.kind not in "fiu":
        raise InputError(f"{name}: values of type {volume.dtype} are not real numbers")
    for axis in AXES:
        if axis not in volume.coords:
            raise InputError(f"{name}.{axis}: coordinate missing; give it in m")
        units = volume[axis].attrs.get("units")
        if units not in ("m", "metre", "metres", "meter", "meters"):
            raise InputError(f"{name}.{axis}: units {units!r} are not 'm'")
        nodes = volume[axis].values.astype(float)
        steps = np.diff(nodes)
        if not steps.size or not np.isfinite(steps).all() or steps.min() <= 0:
            raise InputError(
                f"{name}.{axis}: {len(nodes)} value{'s' * (len(nodes) != 1)}, not at least two "
                "finite, ascending ones"
            )
        if np.ptp(steps) > 1e-3 * steps.mean():
            raise InputError(
                f"{name}.{axis}: spacing from {steps.min():g} to {steps.max():g} m is not "
                "uniform (to 0.1 %)"
            )
    return volume.transpose(*AXES)


def _same_grid(first: xr.DataArray, other: xr.DataArray, name: str) -> None:
    if first.shape != other.shape:
        sizes = " and ".join(" x ".join(map(str, v.shape)) for v in (first, other))
        raise InputError(f"{name}: sizes {sizes} voxels (x, z, y) differ; expected one grid")
    for axis in AXES:
        off = np.abs(first[axis].values.astype(float) - other[axis].values.astype(float)).max()
        if off > 1e-3 * _spacing(first, axis):
            raise InputError(
                f"{name}.{axis}: up to {off:g} m off volume1's; resample both onto one grid"
            )
