"""Wind in one gate, from it and from the gates before and behind it: the method of `several_gates`.

It is no part of the package, as it pays in one of two kinds of air.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import minimize

from lidar_mi.errors import InputError
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.wind.options import IMAGE_WINDOWS, VALIDATION, VectorValidation, WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

# Central differences along x of second and fourth order, over the distance of two gates.
_DIFFERENCES = {3: (-1 / 2, 0.0, 1 / 2), 5: (1 / 12, -2 / 3, 0.0, 2 / 3, -1 / 12)}


def retrieve_wind_of_gates(
    gates1: xr.DataArray,
    gates2: xr.DataArray,
    dt: float,
    *,
    windows: WindowSizes = IMAGE_WINDOWS,
    validation: VectorValidation = VALIDATION,
    noise: float | xr.DataArray | None = None,
    blur: float = 0.0,
    settings: VariationalSettings | None = None,
    checks: bool = True,
    device: str | torch.device = "cpu",
) -> xr.Dataset:
    """Wind in the middle one of three or five gates, by "variational".

    Wind along x carries structure through the image plane, which no wind in the plane explains. To
    first order it changes the image by -u dt dI/dx, and the gates before and behind give dI/dx. u
    is estimated by regression of what the wind in the plane leaves on dI/dx, in Gaussian windows of
    half a template, shrunk by its own rms (marginal likelihood). The wind is then retrieved from
    images that are corrected for it. u itself is known too poorly to be returned: in a wake its
    rms error is nine tenths of its rms.

    Parameters
    ----------
    gates1, gates2 : xr.DataArray, dims (x, z, y)
        Images of three or five gates, consecutive and of one thickness, on one grid; x is the
        gates' middle, m. They may differ in brightness by a factor.
    dt, windows, validation, noise, blur, settings, checks, device
        As of `retrieve_wind`; noise is that of the middle gate.

    Returns
    -------
    xr.Dataset, dims (z, y)
        As of `retrieve_wind`. The errors of v and w contain what an error of u does to them.

    Raises
    ------
    InputError
        Another number of gates, gates that are not equally spaced; else as `retrieve_wind`.
    """
    spacing = _spacing(gates1, gates2)
    middle = gates1.sizes["x"] // 2
    scans = [_in_one_brightness(gates.transpose("x", "z", "y")) for gates in (gates1, gates2)]
    images = [scan.isel(x=middle, drop=True) for scan in scans]
    options: dict[str, Any] = {
        "windows": windows,
        "validation": validation,
        "noise": noise,
        "blur": blur,
        "settings": settings,
        "checks": checks,
        "device": device,
    }
    alone = retrieve_wind(images[0], images[1], dt, **options)
    slopes = [along_x(scan.values, spacing) for scan in scans]
    through = _through_plane(images, slopes, alone, dt, windows.template / 2)
    corrected = [
        image - sign * 0.5 * dt * through.u * np.mean(slopes, 0)
        for sign, image in zip((1, -1), images, strict=True)
    ]
    wind = retrieve_wind(corrected[0], corrected[1], dt, **options)
    return _with_errors_of_u(wind, through)


class _Through(NamedTuple):
    """Wind along x at each pixel (z, y).

    Attributes
    ----------
    z, y : np.ndarray
        m
    u, variance : np.ndarray
    response : np.ndarray, shape (2, z, y)
        Change of v and w by that of u.
    """

    z: np.ndarray
    y: np.ndarray
    u: np.ndarray
    variance: np.ndarray
    response: np.ndarray


def _spacing(gates1: xr.DataArray, gates2: xr.DataArray) -> float:
    """Distance of the gates, m."""
    for name, gates in (("gates1", gates1), ("gates2", gates2)):
        if set(gates.dims) != {"x", "z", "y"}:
            raise InputError(f"{name}: dims {gates.dims} are not allowed; expected (x, z, y)")
        if gates.sizes["x"] not in _DIFFERENCES:
            raise InputError(f"{name}: {gates.sizes['x']} gates are not allowed; expected 3 or 5")
    x = gates1["x"].values.astype(float)
    steps = np.diff(x)
    if not (steps[0] > 0 and np.ptp(steps) < 1e-3 * steps[0]):
        raise InputError(
            f"gates1.x: {x} m is not allowed; expected ascending, equally spaced gates"
        )
    if not np.allclose(gates2["x"], x, rtol=0, atol=1e-3 * steps[0]):
        raise InputError(f"gates2.x: {gates2['x'].values} m is not allowed; expected {x} m")
    return float(steps.mean())


def _in_one_brightness(scan: xr.DataArray) -> xr.DataArray:
    """Gates of one mean, that of the middle one: a fall of light along x is no gradient of air."""
    mean = scan.mean(("z", "y"))
    return scan * (mean.isel(x=scan.sizes["x"] // 2, drop=True) / mean)


def along_x(gates: np.ndarray, spacing: float) -> np.ndarray:
    """Derivative along x in the middle gate (z, y), per m; 0 where a gate has no value."""
    found = np.tensordot(_DIFFERENCES[len(gates)], gates, 1) / spacing
    return np.where(np.isfinite(found), found, 0.0)


def _through_plane(
    images: list[xr.DataArray], slopes: list[np.ndarray], wind: xr.Dataset, dt: float, width: float
) -> _Through:
    """u by what the wind in the plane leaves of the difference of the images.

    Gaussian windows of standard deviation `width` px.
    """
    z, y = (images[0][axis].values.astype(float) for axis in "zy")
    steps = [axis[1] - axis[0] for axis in (z, y)]
    values = [_filled(image.values.astype(float)) for image in images]
    at_pixels = [
        np.clip(axis, *wind[name].values[[0, -1]]) for axis, name in zip((z, y), "zy", strict=True)
    ]
    in_plane = [
        _filled(wind[name].values.astype(float), wind["flag"].values == 0) for name in ("w", "v")
    ]
    grid = np.meshgrid(*at_pixels, indexing="ij")
    axes = wind["z"].values, wind["y"].values
    half = [
        RegularGridInterpolator(axes, part)(np.stack(grid, -1)) * dt / 2 / step
        for part, step in zip(in_plane, steps, strict=True)
    ]
    rows, columns = np.indices(values[0].shape)

    def warped(field: np.ndarray, sign: int) -> np.ndarray:
        places = [rows + sign * half[0], columns + sign * half[1]]
        return map_coordinates(field, places, order=3, mode="nearest")

    first, second = warped(values[0], -1), warped(values[1], 1)
    known = np.isfinite(images[0].values) & np.isfinite(images[1].values)
    slope = -dt * 0.5 * (warped(slopes[0], -1) + warped(slopes[1], 1)) * known
    left = (second - first) * known

    def of_window(field: np.ndarray) -> np.ndarray:
        return gaussian_filter(field, width)

    power = of_window(slope**2) + 1e-30 * float(np.mean(left**2)) + 1e-300
    raw = of_window(left * slope) / power
    # were the differences independent from pixel to pixel
    variance = of_window(left**2) / power / (4 * np.pi * width**2)
    expected, factor = _likeliest(raw, variance, max(1, round(2 * width)))
    shrunk = expected**2 / (expected**2 + factor * variance)
    u = shrunk * raw
    in_plane_slopes = np.stack(
        [-dt * part for part in np.gradient(0.5 * (first + second), *steps)][::-1]
    )  # along y, along z
    response = _response(in_plane_slopes * known, slope, of_window)
    return _Through(z, y, u, shrunk * factor * variance, response)


def _filled(values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """The mean of what is valid in place of what is not; 0 if nothing is."""
    valid = np.isfinite(values) if valid is None else valid & np.isfinite(values)
    return np.where(valid, values, values[valid].mean() if valid.any() else 0.0)


def _likeliest(raw: np.ndarray, variance: np.ndarray, every: int) -> tuple[float, float]:
    """The rms of u, and the factor of the estimates' variance, of the greatest likelihood.

    Of windows that are `every` px apart, whose estimates are nearly independent. Differences are
    not white: air that no wind explains is smooth.
    """
    some = (slice(every // 2, None, every),) * 2
    square, noise = raw[some].ravel() ** 2, variance[some].ravel()

    def minus_log_likelihood(logarithms: np.ndarray) -> float:
        whole = np.exp(2 * logarithms[0]) + np.exp(logarithms[1]) * noise
        return float(np.mean(np.log(whole) + square / whole))

    start = [0.5 * np.log(np.median(square) + 1e-12), 0.0]
    found = minimize(minus_log_likelihood, start, method="Nelder-Mead")
    rms, factor = np.exp(found.x)
    return float(rms), float(factor)


def _response(
    slopes: np.ndarray, along: np.ndarray, of_window: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Change of v and w (2, z, y) by that of u: slopes in the plane pass for that along x."""
    yy, yz, zz = (of_window(slopes[i] * slopes[j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    uy, uz = (of_window(slope * along) for slope in slopes)
    # windows whose slopes have one direction: the other component is not changed
    ridge = 1e-2 * (yy + zz) + 1e-300
    yy, zz = yy + ridge, zz + ridge
    return -np.stack([zz * uy - yz * uz, yy * uz - yz * uy]) / (yy * zz - yz**2)


def _with_errors_of_u(wind: xr.Dataset, through: _Through) -> xr.Dataset:
    """The wind, with what an error of u does to v and w in their errors."""
    at = np.stack(
        [np.clip(wind[f"{n}_vector"].values, *getattr(through, n)[[0, -1]]) for n in "zy"], -1
    )
    at = np.where(np.isfinite(at), at, [through.z[0], through.y[0]])
    variance, of_v, of_w = (
        RegularGridInterpolator((through.z, through.y), field)(at)
        for field in (through.variance, *through.response)
    )
    v, w = wind["v_stderr"], wind["w_stderr"]
    mixed = wind["vw_correlation"] * v * w + of_v * of_w * variance
    more_v, more_w = np.hypot(v, of_v * variance**0.5), np.hypot(w, of_w * variance**0.5)
    found = {"v_stderr": more_v, "w_stderr": more_w, "vw_correlation": mixed / (more_v * more_w)}
    for name, values in found.items():
        found[name] = wind[name].copy(data=values.values.astype(np.float32))
    return wind.assign(found)
