"""What every retrieval asks of its images: one uniform grid in metres, real numbers."""

import numpy as np
import torch
import xarray as xr

from lidar_mi.errors import InputError

_METRES = ("m", "metre", "metres", "meter", "meters")


def checked_pair(
    image1: xr.DataArray, image2: xr.DataArray, noise: float | xr.DataArray | None = None
) -> tuple[xr.DataArray, xr.DataArray, float | xr.DataArray | None]:
    """Both images, and the noise if it is an image, as (z, y) on one uniform grid.

    Raises
    ------
    InputError
        Naming image and axis: not an image, other dims, units, spacing, size or places.
    """
    image1, image2 = checked_image("image1", image1), checked_image("image2", image2)
    same_grid(image1, image2)
    if isinstance(noise, xr.DataArray):
        noise = checked_image("noise", noise)
        same_grid(image1, noise, "noise")
    return image1, image2, noise


def on_device(image: xr.DataArray, device: str | torch.device) -> torch.Tensor:
    """The image's pixels as a tensor."""
    try:
        target = torch.device(device)
        return torch.as_tensor(np.ascontiguousarray(image.values), device=target)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device: {str(device)!r} cannot be used here ({reason})") from error


def positive(name: str, value: float) -> float:
    """A time in s that is one."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not (number > 0 and np.isfinite(number)):
        raise InputError(f"{name}: {value!r} s is not a number > 0")
    return number


def checked_image(name: str, image: xr.DataArray) -> xr.DataArray:
    """The image as (z, y), its grid known to be in metres, ascending and uniform."""
    if not isinstance(image, xr.DataArray):
        raise InputError(f"{name}: {type(image).__name__} is not an xarray.DataArray")
    if set(image.dims) != {"z", "y"} or image.ndim != 2:
        raise InputError(f"{name}: dims {tuple(image.dims)} are not ('z', 'y')")
    if image.dtype.kind not in "fiu":
        raise InputError(f"{name}: values of type {image.dtype} are not real numbers")
    for axis in ("z", "y"):
        if axis not in image.coords:
            raise InputError(f"{name}.{axis}: coordinate missing; give it in m")
        coordinate = image[axis]
        units = coordinate.attrs.get("units")
        if units not in _METRES:
            raise InputError(f"{name}.{axis}: units {units!r} are not 'm'")
        steps = np.diff(coordinate.values.astype(float))
        if not steps.size or not np.isfinite(steps).all() or steps.min() <= 0:
            raise InputError(f"{name}.{axis}: not at least two finite, ascending values")
        if np.ptp(steps) > 1e-3 * steps.mean():
            raise InputError(
                f"{name}.{axis}: spacing from {steps.min():g} to {steps.max():g} m is not "
                "uniform (to 0.1 %)"
            )
    return image.transpose("z", "y")


def same_grid(image1: xr.DataArray, image2: xr.DataArray, name: str = "image2") -> None:
    """Raise unless the two lie on the same pixels."""
    if image1.shape != image2.shape:
        sizes = " and ".join(f"{z} x {y}" for z, y in (image1.shape, image2.shape))
        raise InputError(f"{name}: sizes {sizes} px (z x y) differ; both must have one grid")
    for axis in ("z", "y"):
        first, second = (image[axis].values.astype(float) for image in (image1, image2))
        off = np.abs(first - second).max()
        if off > 1e-3 * np.diff(first).mean():
            raise InputError(
                f"{name}.{axis}: up to {off:g} m off image1's; resample both onto one grid"
            )
