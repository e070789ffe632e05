"""From many images to the wind in time: pair by pair, one CF data set out."""

from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.checks import positive
from lidar_mi.retrieval.device import device_of
from lidar_mi.retrieval.images.common_grid import all_on_one_grid
from lidar_mi.retrieval.threads import SMALL, in_turn, threads_for
from lidar_mi.retrieval.wind.pair import retrieve_wind

_PER_PAIR = "identical_images", "sampling", "fixed_pattern", "illumination"
"""Attributes of a wind that are remarks on its images."""


@checked_arguments
def retrieve_winds(
    images: Sequence[xr.DataArray] | xr.DataArray,
    dt: float | Sequence[float],
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    noise: float | Sequence[float | xr.DataArray | None] | xr.DataArray | None = None,
    beam_times: Sequence[xr.DataArray] | None = None,
    notice: Callable[[str, float], object] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Wind in the image plane from each pair of a sequence or a stack of images.

    Each pair has the wind that `retrieve_wind` gives. Pairs of small images (up to 2^18 px) are
    retrieved at the same time, one on each thread that torch may use.

    Parameters
    ----------
    images : sequence of xr.DataArray, dims (z, y), or one of dims (any, z, y)
        In the order of their times, of one size. Images on different grids are resampled onto one,
        which covers what all of them cover (`on_one_grid`).
    dt : float or sequence of float
        Time from each image to the next, s: one for all, or one for each step.
    pairs : sequence of (int, int), optional
        Which images make a pair, from 0, the earlier first. Default: each with the next. Of a stack
        of pairs: ``[(0, 1), (2, 3), ...]``.
    noise : float, sequence of float, xr.DataArray or None, or xr.DataArray, optional
        Standard deviation of the noise, as of `retrieve_wind`: one for all images, or one an image,
        also as a stack.
    beam_times : sequence of xr.DataArray, optional
        When each pixel of each image was seen, as ``times`` of `retrieve_wind`.
    notice : callable, optional
        Called with a text and the fraction done (0 to 1) for each pair, before its retrieval.
    **options
        Further arguments of `retrieve_wind`, the same for all pairs: ``method``, ``windows``,
        ``validation`` and so on.

    Returns
    -------
    xr.Dataset, dims (time, z, y)
        Variables of `retrieve_wind`, of which ``time`` is called ``vector_time``. ``time`` (s)
        is the middle of a pair's two reference times. All times are from the first image's
        reference time. ``first_image``, ``second_image``, ``dt`` (s) and ``remark`` belong to a
        pair. A pair from which no wind can be retrieved has no values (NaN, flag "no_match");
        its remark says why.

    Raises
    ------
    InputError
        Fewer than two images, an impossible pair, arguments with which no pair can be retrieved.

    Examples
    --------
    Air that moves by two pixels of 0.5 m along y in 0.1 s, and by three in the next:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> air = 1 + gaussian_filter(np.random.default_rng(1).normal(size=(32, 54)), 1.5)
    >>> axes = {d: (d, 0.5 * np.arange(n), {"units": "m"}) for d, n in (("z", 32), ("y", 48))}
    >>> images = [xr.DataArray(air[:, k : k + 48], axes, ("z", "y")) for k in (5, 3, 0)]
    >>> winds = lm.retrieve_winds(images, dt=0.1)
    >>> winds["time"].values.round(2).tolist()
    [0.05, 0.15]
    >>> [f"{speed:.0f}" for speed in winds["v"].median(("z", "y")).values]
    ['10', '15']
    """
    images = _unstacked("images", images)
    chosen = _checked_pairs(pairs, len(images))
    times = _reference_times(dt, len(images))
    if "more" in options or "times" in options:
        raise InputError("more, times: not allowed in a series of pairs; expected beam_times")
    if beam_times is not None and len(beam_times) != len(images):
        raise InputError(
            f"beam_times: {len(beam_times)} are not allowed; expected {len(images)}, one an image"
        )
    if isinstance(noise, xr.DataArray):
        noise = _unstacked("noise", noise)
    levels: list[float | xr.DataArray | None] = (
        list(noise) if isinstance(noise, Sequence) else [noise] * len(images)
    )
    if len(levels) != len(images):
        raise InputError(
            f"noise: {len(levels)} are not allowed; expected one, or {len(images)}, one an image"
        )
    shared = all_on_one_grid(images)
    pixel_times = None if beam_times is None else all_on_one_grid(beam_times)
    if any(new is not given for new, given in zip(shared, images, strict=True)):
        # noise cannot be interpolated: its median is used
        levels = [float(n.median()) if isinstance(n, xr.DataArray) else n for n in levels]

    def of_pair(pair: tuple[int, int]) -> xr.Dataset | InputError:
        first, second = pair
        when = None if pixel_times is None else [pixel_times[first], pixel_times[second]]
        step = times[second] - times[first]
        try:
            return retrieve_wind(
                shared[first], shared[second], step, times=when, noise=levels[first], **options
            )
        except InputError as error:
            return error

    pixels = shared[0].size
    # threads would share a GPU
    side_by_side = pixels <= SMALL and device_of(options.get("device", "cpu")).type == "cpu"
    results: list[xr.Dataset | InputError] = []
    each = in_turn(of_pair, chosen) if side_by_side else (of_pair(pair) for pair in chosen)
    with threads_for(pixels), closing(each):
        for number, (first, second) in enumerate(chosen):
            if notice is not None:
                notice(f"images {first}-{second}", number / len(chosen))
            results.append(next(each))
    winds = [wind for wind in results if isinstance(wind, xr.Dataset)]
    if not winds:
        raise InputError(f"images {chosen[0][0]}-{chosen[0][1]}: {results[0]}")
    whole = xr.concat(
        [_of_pair(wind, winds[0], times[a]) for (a, _), wind in zip(chosen, results, strict=True)],
        "time",
        combine_attrs="drop_conflicts",
        # concatenated even where they are equal in all pairs
        coords=["y_vector", "z_vector"],
        compat="equals",
    )
    return whole.assign_attrs(
        title="Wind in the image plane from pairs of a sequence"
    ).assign_coords(
        time=("time", [(times[a] + times[b]) / 2 for a, b in chosen], _about("middle of the pair")),
        first_image=("time", [a for a, _ in chosen], {"long_name": "earlier image, from 0"}),
        second_image=("time", [b for _, b in chosen], {"long_name": "later image, from 0"}),
        dt=(
            "time",
            [times[b] - times[a] for a, b in chosen],
            {"long_name": "time between the images", "units": "s"},
        ),
        remark=("time", [_remark(wind) for wind in results], {"long_name": "remark on the images"}),
    )


def _unstacked(name: str, images: Sequence[xr.DataArray] | xr.DataArray) -> Sequence[xr.DataArray]:
    """A sequence of images, or those of a stack along its first dimension."""
    if not isinstance(images, xr.DataArray):
        return images
    if images.dims[1:] != ("z", "y"):
        raise InputError(
            f"{name}: dimensions {', '.join(map(str, images.dims))} are not allowed; expected any, "
            "z, y, or a sequence"
        )
    return list(images.drop_vars([images.dims[0]], errors="ignore"))


def _checked_pairs(pairs: Sequence[tuple[int, int]] | None, count: int) -> list[tuple[int, int]]:
    """The pairs as given or by default, checked."""
    if count < 2:
        raise InputError(f"images: {count} are not allowed; expected two or more")
    chosen = list(pairwise(range(count))) if pairs is None else list(pairs)
    if not chosen:
        raise InputError("pairs: none given; expected one or more")
    for first, second in chosen:
        if not 0 <= first < second < count:
            raise InputError(
                f"pairs: {first}-{second} is not allowed; expected two of the images 0 to "
                f"{count - 1}, the earlier first"
            )
    return [(int(first), int(second)) for first, second in chosen]


def _reference_times(dt: float | Sequence[float], count: int) -> list[float]:
    """Reference time of each image from the first, s."""
    steps = list(dt) if isinstance(dt, Sequence) else [dt] * (count - 1)
    if len(steps) != count - 1:
        raise InputError(
            f"dt: {len(steps)} steps are not allowed with {count} images; expected one, or "
            f"{count - 1}"
        )
    whole = np.cumsum([0.0, *(positive("dt", step) for step in steps)])
    # rounded, so that sums of steps such as 0.1 s are exact
    return [float(f"{time:.12g}") for time in whole]


def _about(what: str) -> dict[str, str]:
    return {"long_name": f"{what}, from the first image's reference time", "units": "s"}


def _of_pair(result: xr.Dataset | InputError, like: xr.Dataset, start: float) -> xr.Dataset:
    """A pair's wind with times from the first image; without values where there is none."""
    wind = result if isinstance(result, xr.Dataset) else _nothing(like)
    wind = (
        wind.rename(time="vector_time")
        .drop_attrs(deep=False)
        .assign_attrs(
            {name: value for name, value in wind.attrs.items() if name not in (*_PER_PAIR, "dt")}
        )
    )
    later = wind["vector_time"].astype(float) + start
    return wind.assign(vector_time=later.assign_attrs(_about("mid-time of the vector")))


def _nothing(like: xr.Dataset) -> xr.Dataset:
    """A wind without vectors on the grid of another."""
    empty = {
        name: xr.full_like(values, Flag.NO_MATCH.value if name == "flag" else np.nan)
        for name, values in like.data_vars.items()
    }
    at_rest = {f"{axis}_vector": like[axis].broadcast_like(like["v"]) for axis in ("y", "z")}
    places = {
        name: like[name].copy(data=values.transpose(*like[name].dims).astype(like[name].dtype))
        for name, values in at_rest.items()
    }
    return like.assign(empty).assign_coords(places)


def _remark(result: xr.Dataset | InputError) -> str:
    if isinstance(result, InputError):
        return str(result)
    return ", ".join(str(result.attrs[name]) for name in _PER_PAIR if name in result.attrs)
