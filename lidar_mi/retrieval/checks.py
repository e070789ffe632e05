"""Checks of a retrieval's images: one uniform grid in metres, real numbers."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.device import device_of

LARGEST = 1e100
"""Of the values of an image: sums of their products are finite."""
_METRES = ("m", "metre", "metres", "meter", "meters")


def checked_stack(
    stack: Sequence[xr.DataArray],
    noise: float | xr.DataArray | None = None,
    axes: Sequence[str] = ("z", "y"),
    name: str = "image",
) -> tuple[list[xr.DataArray], float | xr.DataArray | None]:
    """All images, and the noise if it is an image, with these dims on one uniform grid.

    Where image 1 is not finite either, as outside of the beams of a resampled scan, unknown noise
    is replaced by the median, which has no effect.

    Raises InputError: naming image and axis: not an image, other dims, units, spacing, size or
    places.
    """
    stack = [checked_image(f"{name}{n}", image, axes) for n, image in enumerate(stack, 1)]
    others = {f"{name}{n}": image for n, image in enumerate(stack[1:], 2)}
    if isinstance(noise, xr.DataArray):
        noise = others["noise"] = checked_image("noise", noise, axes)
    for label, image in others.items():
        same_grid(stack[0], image, label, f"{name}1")
    if isinstance(noise, xr.DataArray):
        unknown = np.isnan(noise) & ~np.isfinite(stack[0])
        if bool(unknown.any()):
            noise = noise.where(~unknown, float(noise.median()))
    return stack, noise


def identical(
    images: Sequence[xr.DataArray | np.ndarray] | np.ndarray, name: str = "images", start: int = 1
) -> str:
    """Which images, counted from a start, are the same as the one before, in words; empty: none.

    Two exposures never are: one image was given twice.
    """
    same = [
        f"{first} and {first + 1}"
        for first, (image, following) in enumerate(pairwise(iter(images)), start)
        if np.array_equal(np.asarray(image), np.asarray(following), equal_nan=True)
    ]
    more = f" and {len(same) - 3} more pairs" if len(same) > 3 else ""
    return f"{name} {', '.join(same[:3])}{more} are the same, bit for bit" if same else ""


def on_device(image: xr.DataArray, device: str | torch.device) -> torch.Tensor:
    """The image's pixels as a tensor."""
    try:
        target = device_of(device)
        return torch.as_tensor(np.ascontiguousarray(image.values), device=target)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device: {str(device)!r} cannot be used here ({reason})") from error


def positive(name: str, value: float) -> float:
    """A time in s, checked to be finite and > 0."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not (number > 0 and np.isfinite(number)):
        raise InputError(f"{name}: {value!r} s is not a number > 0")
    return number


def checked_image(name: str, image: xr.DataArray, axes: Sequence[str] = ("z", "y")) -> xr.DataArray:
    """The image with these dims in this order, its grid in metres, ascending and uniform."""
    if not isinstance(image, xr.DataArray):
        raise InputError(f"{name}: {type(image).__name__} is not an xarray.DataArray")
    if set(image.dims) != set(axes) or image.ndim != len(axes):
        raise InputError(f"{name}: dims {tuple(image.dims)} are not {tuple(axes)}")
    if image.dtype.kind not in "fiu":
        raise InputError(f"{name}: values of type {image.dtype} are not real numbers")
    # of finite images without picking their pixels, which takes five times as long
    values = image.values
    if values.size and not (np.isfinite(values.min()) and np.isfinite(values.max())):
        values = values[np.isfinite(values)]
    largest = max(float(values.max()), -float(values.min())) if values.size else 0.0
    if largest > LARGEST:
        raise InputError(f"{name}: values up to {largest:g}; expected at most {LARGEST:g}")
    # variables: a coordinate as a DataArray takes as long as all checks of it
    coordinates = image.coords.variables
    for axis in axes:
        if axis not in coordinates:
            raise InputError(f"{name}.{axis}: coordinate missing; give it in m")
        coordinate = coordinates[axis]
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
    return image if image.dims == tuple(axes) else image.transpose(*axes)


def same_grid(
    image1: xr.DataArray, image2: xr.DataArray, name: str = "image2", first: str = "image1"
) -> None:
    """Raise unless the two lie on the same pixels."""
    if image1.shape != image2.shape:
        sizes = " and ".join(" x ".join(map(str, shape)) for shape in (image1.shape, image2.shape))
        unit = "px" if image1.ndim == 2 else "voxels"
        axes = " x ".join(map(str, image1.dims))
        raise InputError(f"{name}: sizes {sizes} {unit} ({axes}) differ; both must have one grid")
    for axis in image1.dims:
        nodes1, nodes2 = (i.coords.variables[axis].values.astype(float) for i in (image1, image2))
        off = np.abs(nodes1 - nodes2).max()
        if off > 1e-3 * np.diff(nodes1).mean():
            raise InputError(
                f"{name}.{axis}: up to {off:g} m off {first}'s; resample both onto one grid"
            )
