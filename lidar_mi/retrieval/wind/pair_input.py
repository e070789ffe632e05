"""Input of a retrieval from images, checked and as tensors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_stack, identical, on_device, positive
from lidar_mi.retrieval.images.beam_times import checked_times
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.methods import METHODS, Method
from lidar_mi.retrieval.wind.options import WindowSizes


class PairInput(NamedTuple):
    """Two images of the same air, or a burst of more.

    images (z, y): on one grid.
    pixels (z, y): their values.
    dt: from reference time to reference time, s.
    noise: standard deviation in image 1.
    times (z, y): when each pixel of two images was seen, s from its image's reference time.
    blur, blur_px: standard deviation of the instrument's blur, m and px.
    same: which images are the same, bit for bit, in words; empty: none.
    """

    images: list[xr.DataArray]
    pixels: list[torch.Tensor]
    windows: Windows
    dt: float
    noise: float | torch.Tensor | None
    times: list[np.ndarray] | None
    blur: float
    blur_px: float
    same: str


def method_of(name: str | Method) -> Method:
    """The method of that name, see `METHODS`."""
    if isinstance(name, Method):
        return name
    if name not in METHODS:
        raise InputError(f"method: {name!r} is not one of {', '.join(METHODS)}")
    return METHODS[name]


def checked_input(
    images: Sequence[xr.DataArray],
    dt: float,
    method: Method,
    windows: WindowSizes,
    noise: float | xr.DataArray | None,
    times: Sequence[xr.DataArray] | None,
    blur: float,
    device: str | torch.device,
) -> PairInput:
    """Arguments of `retrieve_wind`, each refused by its name if it is not suitable."""
    dt = positive("dt", dt)
    stack, level = checked_stack(images, noise)
    for number, image in enumerate(stack, 1):
        if not np.isfinite(image.values).any():
            raise InputError(f"image{number}: no pixel is finite; expected light somewhere")
    if len(stack) > 2 and "more" not in method.options:
        takes = ", ".join(name for name, taking in METHODS.items() if "more" in taking.options)
        raise InputError(
            f"more: {len(stack)} images are not allowed with method {method.name!r}; expected two, "
            f"or method {takes}"
        )
    if times is not None and len(stack) > 2:
        raise InputError(f"times: not allowed with {len(stack)} images; expected two")
    pixel_times = checked_times(times, stack, dt)
    frame, blur_px = windows.on(stack[0].shape), _in_pixels(blur, stack[0])
    pixels = [on_device(image, device) for image in stack]
    sigma = on_device(level, device) if isinstance(level, xr.DataArray) else level
    same = identical(stack)
    return PairInput(stack, pixels, frame, dt, sigma, pixel_times, blur, blur_px, same)


def _in_pixels(blur: float, image: xr.DataArray) -> float:
    """The blur in px, from m."""
    if not 0 <= blur < np.inf:
        raise InputError(f"blur: {blur!r} m is not allowed; expected a standard deviation >= 0")
    z, y = (np.ptp(image[name].values) / (image.sizes[name] - 1) for name in ("z", "y"))
    if blur and abs(z / y - 1) > 0.01:
        raise InputError(
            f"blur: not allowed with pixels of {y:g} m along y and {z:g} m along z; expected "
            "square ones"
        )
    return float(blur / y)
