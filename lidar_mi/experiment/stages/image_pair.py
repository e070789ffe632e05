"""Two images of the same air, and their noise."""

from collections.abc import Callable

import numpy as np
import xarray as xr

Pair = tuple[xr.DataArray, xr.DataArray]
"""Images at t1 and t2, dims (z, y), or volumes, dims (x, z, y)."""

Noise = xr.DataArray | float
"""Standard error of every pixel of an image, or of all its pixels; unit of the image."""


def both(image: Callable[[int], xr.DataArray]) -> Pair:
    """The pair of a function of the number of an image, 0 or 1."""
    return image(0), image(1)


def combined_noise(first: xr.DataArray, second: xr.DataArray) -> xr.DataArray:
    """Standard error by two independent causes of noise: the root sum of squares."""
    # as np.hypot of both, of which numpy's type is an array without dims
    return xr.apply_ufunc(np.hypot, first, second, keep_attrs=True)


def noise_without(noise: Noise, part: Noise) -> Noise:
    """Standard error by the other causes of a noise that has ``part`` by one of them."""

    def others(noise: np.ndarray, part: np.ndarray) -> np.ndarray:
        # rounding may leave a variance below 0 where there is no other cause
        return np.sqrt(np.maximum(noise**2 - part**2, 0))

    return xr.apply_ufunc(others, noise, part)
