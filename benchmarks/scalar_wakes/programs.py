"""Programs that retrieve vectors from a pair: ours, OpenPIV, FF-PIV, OpenCV's DIS.

Of programs that state no errors, `lidar_mi.standard_errors` does.
"""

import contextlib
import io
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import numpy as np
import xarray as xr

import lidar_mi as lm

Program = Callable[[xr.DataArray, xr.DataArray, float], xr.Dataset]
OPENPIV_WINDOWS = (32, 16, 16)
FFPIV_WINDOW = 16
STRIDE = 4


def ours(method: str) -> Program:
    """A method of lidar-mi with its own errors and flags."""

    def find(first: xr.DataArray, second: xr.DataArray, dt: float) -> xr.Dataset:
        return lm.retrieve_wind(first, second, dt, method, windows=lm.WindowSizes(stride=STRIDE))

    return find


def openpiv(first: xr.DataArray, second: xr.DataArray, dt: float, backend: str) -> xr.Dataset:
    """Window deformation with windows of 32, 16, 16 px, validation as it comes.

    Correlations are by SciPy ("scipy"), or by the package openpiv-rust ("rust").
    """
    from openpiv.settings import PIVSettings
    from openpiv.windef import simple_multipass

    overlaps = tuple(window - step for window, step in zip(OPENPIV_WINDOWS, (8, 4, 4), strict=True))
    options = PIVSettings(
        windowsizes=OPENPIV_WINDOWS,
        overlap=overlaps,
        num_iterations=len(OPENPIV_WINDOWS),
        subpixel_method="gaussian",
        deformation_method="symmetric",
        sig2noise_method=None,
        sig2noise_validate=False,
        backend=backend,
    )
    with contextlib.redirect_stdout(io.StringIO()):
        _, _, right, up, _ = simple_multipass(first.values, second.values, options)
    # rows are z, ascending; OpenPIV assumes descending ones, and inverts the sign
    start = (OPENPIV_WINDOWS[-1] - 1) / 2
    return _with_errors(first, second, right, -up, dt, start, 4, OPENPIV_WINDOWS[-1])


def ffpiv(first: xr.DataArray, second: xr.DataArray, dt: float) -> xr.Dataset:
    """One pass of windows of 16 px, each with its mean and its standard deviation removed."""
    import ffpiv as package

    shape, overlap = (FFPIV_WINDOW,) * 2, (FFPIV_WINDOW - STRIDE,) * 2
    right, up = package.piv(
        first.values, second.values, window_size=shape, overlap=overlap, normalize=True
    )
    start = (FFPIV_WINDOW - 1) / 2
    return _with_errors(first, second, right, up, dt, start, STRIDE, FFPIV_WINDOW)


def dis(first: xr.DataArray, second: xr.DataArray, dt: float) -> xr.Dataset:
    """Dense inverse search, medium preset, on 8 bits; its patches have 8 px."""
    import cv2

    low, high = np.quantile(first.values, [0.001, 0.999])
    images = [
        np.clip((image.values - low) / (high - low) * 255, 0, 255).astype(np.uint8)
        for image in (first, second)
    ]
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = search.calc(*images, None)[::STRIDE, ::STRIDE]
    return _with_errors(first, second, flow[..., 0], flow[..., 1], dt, 0.0, STRIDE, 8)


def _with_errors(
    first: xr.DataArray,
    second: xr.DataArray,
    along_y: np.ndarray,
    along_z: np.ndarray,
    dt: float,
    start: float,
    step: int,
    window: int,
) -> xr.Dataset:
    """Displacements in px as winds, with standard errors."""
    coords, size = {}, {}
    for axis, count in zip(("z", "y"), along_y.shape, strict=True):
        places = first[axis].values
        size[axis] = float(np.diff(places).mean())
        at = places[0] + (start + step * np.arange(count)) * size[axis]
        coords[axis] = (axis, at, {"units": "m"})
    v, w = (
        xr.DataArray(np.ma.filled(moved, np.nan) * size[axis] / dt, coords, ("z", "y"))
        for moved, axis in ((along_y, "y"), (along_z, "z"))
    )
    return lm.standard_errors(first, second, v, w, dt, window=window)


PROGRAMS: dict[str, Program] = {
    "lidar-mi variational": ours("variational"),
    "lidar-mi multipass": ours("multipass"),
    "lidar-mi cc": ours("cc"),
}
if find_spec("openpiv"):
    PROGRAMS["OpenPIV, 16 px"] = partial(openpiv, backend="scipy")
    if find_spec("openpiv_rust"):
        PROGRAMS["OpenPIV in Rust, 16 px"] = partial(openpiv, backend="rust")
if find_spec("ffpiv"):
    PROGRAMS["FF-PIV, 16 px"] = ffpiv
if find_spec("cv2"):
    PROGRAMS["OpenCV DIS"] = dis
