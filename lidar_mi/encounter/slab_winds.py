"""The winds of successive slabs, each from the one before; here or in a process of its own."""

import gc
import time
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import loky
import numpy as np
import torch
import xarray as xr

from lidar_mi.retrieval.flow.next_flow import ExpectedFlow, Flow
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.retrieval.vortices.model import wind as model_wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.slabs import expected_wind, wind_of_slab

Complete = Callable[[xr.Dataset], tuple[xr.Dataset, tuple[str, ...]]]
"""From the images' wind to the wind that is delivered, and flags."""

# Of both vortices, z and y, among the parameters of a pair.
_PLACES = ([3, 7], [2, 6])
# Fraction of the vectors whose flag limits the use of a slab's wind.
_MOST = 0.5


class FirstImage(NamedTuple):
    """The first image of a slab, and the pair of vortices that is expected there.

    Attributes
    ----------
    image : DataArray, dims (z, y)
    dt : float
        To the second image, s.
    noise : float or DataArray, optional
        As `retrieve_wind` takes it.
    times : sequence of two DataArray, optional
        Of the pixels, as `retrieve_wind` takes them.
    expected : VortexPairFit, optional
        At mid-time.
    """

    image: xr.DataArray
    dt: float
    noise: float | xr.DataArray | None = None
    times: Sequence[xr.DataArray] | None = None
    expected: VortexPairFit | None = None


class Found(NamedTuple):
    """The wind of a slab.

    Attributes
    ----------
    wind : Dataset
    flags : tuple of str
        What limits the images' wind (`limits`), and those of its completion.
    seconds : dict
        Of the parts `wind`, and `combination` if it was completed.
    """

    wind: xr.Dataset
    flags: tuple[str, ...]
    seconds: dict[str, float]


def limits(wind: xr.Dataset) -> tuple[str, ...]:
    """What half of the vectors or more are flagged for, in words, such as "wind: no skill"."""
    flag = wind["flag"]
    return tuple(
        f"wind: {name.replace('_', ' ')}"
        for name, mask in zip(
            flag.attrs["flag_meanings"].split(), np.ravel(flag.attrs["flag_masks"]), strict=True
        )
        if ((flag.values & mask) != 0).mean() >= _MOST
    )


class SlabWinds:
    """The winds of successive slabs by one method.

    By "variational" a wind starts from the last one, moved with the expected pair and changed as
    the winds of both pairs differ. It does not wait for this slab's vortices. Other methods start
    from nothing.

    Parameters
    ----------
    method : ImageMethod
    windows : mapping
        Options of `retrieve_wind`.
    """

    def __init__(self, method: ImageMethod, windows: dict[str, Any]):
        self._method, self._windows = method, windows
        self._flow: Flow | None = None
        # the pair of the slab whose wind was found from nothing: prior and noise are known there
        self._learnt: VortexPairFit | None = None
        self._slab: FirstImage
        self._awaited: ExpectedFlow | None = None

    def awaits(self, slab: FirstImage, before: VortexPairFit | None) -> Callable[[], float]:
        """Take the first image of the next slab, before the second one is there.

        Parameters
        ----------
        slab : FirstImage
        before : VortexPairFit, optional
            Found in the last slab.

        Returns
        -------
        callable
            Does what can be done of the wind without the second image, and gives the time (s) that
            it took.
        """
        return partial(self._awaits, slab, before)

    def begun(self, second: xr.DataArray, complete: Complete | None = None) -> Callable[[], Found]:
        """The wind of the slab that is awaited, retrieved when it is asked for.

        Parameters
        ----------
        second : DataArray, dims (z, y)
            The slab's second image.
        complete : callable, optional
            Completes the images' wind. The next one starts from the images' wind alone.

        Returns
        -------
        callable
            Gives the wind as `retrieve_wind` does, completed, and the time that it took. By
            "variational" the attribute `from_start` of the images' wind says whether it was found
            from the last one.
        """
        return partial(self._timed, second, complete)

    # no derivatives are recorded, as in `Estimator.pair_of`
    @torch.inference_mode()
    def _awaits(self, slab: FirstImage, before: VortexPairFit | None) -> float:
        began = time.perf_counter()
        self._slab, start = slab, self._start(slab, before)
        self._awaited = start and expected_wind(slab.image, start, slab.noise)
        return time.perf_counter() - began

    @torch.inference_mode()
    def _timed(self, second: xr.DataArray, complete: Complete | None) -> Found:
        began = time.perf_counter()
        wind = self._wind(second)
        flags = limits(wind)
        seconds = {"wind": time.perf_counter() - began}
        if complete:
            wind, more = complete(wind)
            flags += more
            seconds["combination"] = time.perf_counter() - began - seconds["wind"]
        return Found(wind, flags, seconds)

    def _wind(self, second: xr.DataArray) -> xr.Dataset:
        slab = self._slab
        options = self._windows | {"noise": slab.noise, "times": slab.times}
        images = slab.image, second, slab.dt
        if self._method != ImageMethod.VARIATIONAL:
            return retrieve_wind(*images, str(self._method), **options)
        wind, self._flow = wind_of_slab(*images, self._awaited, **options)
        if not wind.attrs["from_start"]:
            self._learnt = None
        return wind

    def _start(self, slab: FirstImage, before: VortexPairFit | None) -> Flow | None:
        flow, expected = self._flow, slab.expected
        if flow is None or expected is None or before is None:
            return None
        if slab.image.shape != flow.windows.shape:
            return None
        self._learnt = self._learnt or before
        return _moved(flow, slab, before, self._learnt)


def _moved(flow: Flow, slab: FirstImage, before: VortexPairFit, learnt: VortexPairFit) -> Flow:
    """The flow in the last slab's pair, where the next one is expected."""
    axes = [slab.image.coords.variables[name].values.astype(float) for name in ("z", "y")]
    z, y = map(torch.as_tensor, axes)
    step = [float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (z, y)]
    pair = slab.expected
    now, then, first = (torch.as_tensor(fit.parameters) for fit in (pair, before, learnt))
    shift, since = (
        [float((now - other)[places].mean()) for places in _PLACES] for other in (then, first)
    )
    moved = then.clone()
    for places, by in zip(_PLACES, shift, strict=True):
        moved[places] += by
    # displacements to 1e-5 px
    nodes = torch.meshgrid(z.float(), y.float(), indexing="ij")[::-1]
    v, w = (
        a - b
        for a, b in zip(
            *(model_wind(theta.float(), *nodes, pair.profile) for theta in (now, moved)),
            strict=True,
        )
    )
    change = torch.stack([w * slab.dt / step[0], v * slab.dt / step[1]])
    in_pixels = [[by / size for by, size in zip(s, step, strict=True)] for s in (shift, since)]
    return flow.moved(in_pixels[0], change, in_pixels[1])


class InOwnProcess:
    """`SlabWinds` in a process of its own, so that another core does the work meanwhile.

    Its numbers are those of `SlabWinds` but for rounding. The process ends with this object.
    """

    def __init__(self, method: ImageMethod, windows: dict[str, Any]):
        self._pool = loky.ProcessPoolExecutor(1, initializer=_begin, initargs=(method, windows))
        # before the interpreter takes apart what the pool still needs
        weakref.finalize(self, self._pool.shutdown)
        # what is imported once is not a part of the first wind
        self._pool.submit(_ready).result()

    def awaits(self, slab: FirstImage, before: VortexPairFit | None) -> Callable[[], float]:
        """As `SlabWinds.awaits`; done from now on."""
        return self._pool.submit(_awaits, slab, before).result

    def begun(self, second: xr.DataArray, complete: Complete | None = None) -> Callable[[], Found]:
        """As `SlabWinds.begun`; retrieved and completed from now on."""
        return self._pool.submit(_found, second, complete).result


_winds: SlabWinds


def without_old_garbage() -> None:
    """Have what exists by now never searched for garbage again.

    Of all objects of the libraries a search takes 0.1 to 0.4 s: several periods of slabs.
    """
    gc.collect()
    gc.freeze()


def _begin(method: ImageMethod, windows: dict[str, Any]) -> None:
    global _winds
    torch.set_num_threads(1)
    _winds = SlabWinds(method, windows)
    without_old_garbage()


def _ready() -> None:
    """Nothing."""


def _awaits(slab: FirstImage, before: VortexPairFit | None) -> float:
    return _winds.awaits(slab, before)()


def _found(second: xr.DataArray, complete: Complete | None) -> Found:
    return _winds.begun(second, complete)()
