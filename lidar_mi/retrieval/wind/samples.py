"""Winds from the samples of images that have more pixels than samples."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.flags import Flag
from lidar_mi.retrieval.defects.sampling import Sampling
from lidar_mi.retrieval.wind.options import WindowSizes


def samples_fit(
    image: xr.DataArray, structure: Sampling, windows: WindowSizes, square: bool
) -> bool:
    """Whether the samples of an image are enough for the windows, square ones if they must be."""
    lengths = [n // step for n, step in zip(image.shape, structure.steps, strict=True)]
    return min(lengths) >= windows.search + 2 and not (square and len(set(structure.steps)) > 1)


def wind_from_samples(
    retrieve: Callable[..., xr.Dataset],
    images: Sequence[xr.DataArray],
    structure: Sampling,
    windows: WindowSizes,
    noise: float | xr.DataArray | None,
    places: Mapping[str, Any],
    **options: Any,
) -> xr.Dataset:
    """The wind from the samples of images or volumes that have more pixels than samples.

    Images are in the order of time; ``windows``, and the places of their centres, are those of the
    pixels.
    """
    first, second, *more = (samples_of(image, structure) for image in images)
    level = samples_of(noise, structure) if isinstance(noise, xr.DataArray) else noise
    sizes = sizes_of_samples(windows, structure)
    wind = retrieve(first, second, windows=sizes, noise=level, more=more, **options)
    return at_windows(wind, places, structure, windows)


def samples_of(image: xr.DataArray, structure: Sampling) -> xr.DataArray:
    """The first pixel of each sample that is whole, at the place of the sample."""
    parts, coords = {}, {}
    for name, step, first, middle in zip(
        map(str, image.dims), structure.steps, structure.first, structure.middle, strict=True
    ):
        # without a middle one pixel of each kind is a whole sample
        last = image.sizes[name] - (step - 1 if middle else 0)
        parts[name] = slice(first, last, step)
        axis = image[name]
        spacing = float(axis[-1] - axis[0]) / (axis.size - 1)
        coords[name] = axis[parts[name]].copy(data=axis.values[parts[name]] + middle * spacing)
    return image.isel(parts).assign_coords(coords)


def sizes_of_samples(windows: WindowSizes, structure: Sampling) -> WindowSizes:
    """Windows of as many samples as they have pixels, as densely as they were."""
    stride = max(1, windows.stride // max(structure.steps))
    return WindowSizes(windows.template, windows.search, stride)


def at_windows(
    sampled: xr.Dataset, coords: Mapping[str, Any], structure: Sampling, windows: WindowSizes
) -> xr.Dataset:
    """A wind from samples at the places of the windows of the pixels.

    It is interpolated linearly between vectors that are a sample or a stride apart. A vector has
    the flags of the nearest one.
    """
    axes: Sequence[str] = [str(name) for name in sampled["v"].dims if name in coords]
    at = {name: xr.DataArray(np.asarray(coords[name][1]), dims=name) for name in axes}
    near = sampled["flag"].interp(at, method="nearest", kwargs={"fill_value": "extrapolate"})
    wind = sampled.drop_vars("flag").interp(at)
    outside = ~np.isfinite(wind["v"]) & (near == 0)
    flag = near.where(~outside, Flag.NO_MATCH.value).astype(sampled["flag"].dtype)
    wind = wind.assign(flag=flag.assign_attrs(sampled["flag"].attrs))
    for name in axes:
        wind[name].attrs.update(sampled[name].attrs)
    remark = ", ".join(filter(None, [structure.said, sampled.attrs.get("sampling", "")]))
    return wind.assign_attrs(sampled.attrs, stride=windows.stride, sampling=remark)
