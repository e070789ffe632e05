"""The time that passes between the two views of the same air, vector by vector.

A scan is not a photograph: every pixel has its own time. Air that moves against the order of the
beams is met earlier in the second scan than a time step later, air that moves with it later.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import uniform_filter

from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_image, same_grid
from lidar_mi.retrieval.images.common_grid import nearest_filled
from lidar_mi.retrieval.images.windows import Windows


class VectorTimes(NamedTuple):
    """Of every vector, s, arrays of shape `windows.count`.

    difference: from the view in image 1 to that in image 2; NaN where it is not positive.
    middle: half way between the two, from image 1's reference time.
    """

    difference: float | np.ndarray
    middle: np.ndarray


def checked_times(
    times: Sequence[xr.DataArray] | None, images: Sequence[xr.DataArray], dt: float
) -> list[np.ndarray] | None:
    """Times of the pixels of two images (z, y), s, each from its image's reference time.

    Pixels that have no time because they have no value take that of the nearest.

    Raises InputError: not two images of times on the grid of the images, pixels with a value but no
    time, pixels that are seen in image 2 before they are in image 1.

    Returns
    -------
    list of ndarray or None
        None: all pixels of an image have one time.
    """
    if times is None:
        return None
    if len(times) != 2 or len(images) != 2:
        raise InputError(
            f"times: {len(times)} for {len(images)} images are not allowed; expected those of two "
            "images"
        )
    pixel_times = []
    for number, (time, image) in enumerate(zip(times, images, strict=True)):
        name = f"times[{number}]"
        time = checked_image(name, time)
        same_grid(images[0], time, name)
        values = time.values.astype(float)
        without = int((np.isfinite(image.values) & ~np.isfinite(values)).sum())
        if without or not np.isfinite(values).any():
            raise InputError(
                f"{name}: {without or values.size} pixels are not finite; expected a time in s for "
                "every pixel that has a value"
            )
        pixel_times.append(values)
    delay = dt + pixel_times[1] - pixel_times[0]
    if np.nanmin(delay, initial=np.inf) <= 0:
        raise InputError(
            f"times: dt = {dt:g} s is not allowed, as a pixel is seen {np.nanmin(delay):g} s after "
            "the first scan saw it; expected more than 0 s"
        )
    if not any(np.nan_to_num(values).any() for values in pixel_times):
        return None
    return [nearest_filled(values) for values in pixel_times]


def vector_times(
    times: Sequence[np.ndarray] | None, dt: float, windows: Windows, d: np.ndarray, centred: bool
) -> VectorTimes:
    """The time difference and the mid-time of vectors.

    The air of a vector with the displacement d about the mid-place x is seen in image 1 at
    x - d / 2 at the time tau_1(x - d / 2), in image 2 at x + d / 2 at dt + tau_2(x + d / 2). So

        difference = dt + tau_2(x + d / 2) - tau_1(x - d / 2) ,

    with times averaged over the template as the displacement is. Exact where the wind is uniform
    over the template and times are linear over it.

    times: from `checked_times`.
    dt: from reference time to reference time, s.
    d (2, *windows.count): px
    centred: the window's centre is the mid-place x, not the place x - d / 2 in image 1.
    """
    if times is None:
        return VectorTimes(dt, np.full(windows.count, dt / 2))
    d = np.nan_to_num(np.asarray(d, dtype=float))
    starts = [np.asarray(windows.starts(axis), dtype=float) for axis in (0, 1)]
    start = np.stack(np.meshgrid(*starts, indexing="ij"))
    before, after = (-0.5, 0.5) if centred else (0.0, 1.0)
    first, second = (
        _of_templates(values, windows.template, start + part * d)
        for values, part in zip(times, (before, after), strict=True)
    )
    difference = dt + second - first
    return VectorTimes(np.where(difference > 0, difference, np.nan), (first + dt + second) / 2)


def _of_templates(values: np.ndarray, template: int, start: np.ndarray) -> np.ndarray:
    """Means (...) over templates that start at places (2, ...) between pixels, px."""
    boxes = uniform_filter(values, template)
    half = template // 2
    boxes = boxes[tuple(slice(half, half + n - template + 1) for n in values.shape)]
    axes = [np.arange(n, dtype=float) for n in boxes.shape]
    read = RegularGridInterpolator(axes, boxes, bounds_error=False, fill_value=None)
    return read(np.moveaxis(start, 0, -1))
