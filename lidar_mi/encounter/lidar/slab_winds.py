"""The winds of successive slabs, each from the one before; here or in a process of its own."""

import gc
import time
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, ParamSpec, TypeVar

import loky
import torch
import xarray as xr

from lidar_mi.flags import masks_of
from lidar_mi.retrieval.flow.next_flow import ExpectedFlow, Flow
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.retrieval.vortices.model import wind as model_wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.slabs import expected_wind, wind_of_slab

P = ParamSpec("P")
R = TypeVar("R")

Complete = Callable[[xr.Dataset], tuple[xr.Dataset, tuple[str, ...]]]
"""From the images' wind to the wind that is delivered, and flags."""

# Of both vortices, z and y, among the parameters of a pair.
_PLACES = ([3, 7], [2, 6])
# Fraction of the vectors whose flag limits the use of a slab's wind.
_MOST = 0.5


class FirstImage(NamedTuple):
    """The first image of a slab, and the pair of vortices that is expected there.

    image (z, y)
    dt: to the second image, s.
    noise: as `retrieve_wind` takes it.
    times: of the pixels, as `retrieve_wind` takes them.
    expected: at mid-time.
    """

    image: xr.DataArray
    dt: float
    noise: float | xr.DataArray | None = None
    times: Sequence[xr.DataArray] | None = None
    expected: VortexPairFit | None = None


class SlabWind(NamedTuple):
    """The wind of a slab.

    flags: what limits the images' wind (`limits`), and those of its completion.
    seconds: of the parts `wind`, and `combination` if it was completed.
    """

    wind: xr.Dataset
    flags: tuple[str, ...]
    seconds: dict[str, float]


def clock_of(device: object) -> Callable[[], float]:
    """What times the work on a device: processor time, which other work does not lengthen."""
    return time.process_time if str(device) == "cpu" else time.perf_counter


def limits(wind: xr.Dataset) -> tuple[str, ...]:
    """Reasons for which half of the vectors or more are flagged, such as "wind: no skill"."""
    flag = wind["flag"]
    return tuple(
        f"wind: {name.replace('_', ' ')}"
        for name, mask in masks_of(flag.attrs).items()
        if ((flag.values & mask) != 0).mean() >= _MOST
    )


class SlabWinds:
    """The winds of successive slabs by one method; ``windows`` are options of `retrieve_wind`.

    By "variational" a wind starts from the last one, moved with the expected pair and changed by
    the difference of the winds of both pairs; without a pair from the last one as it is. It does
    not depend on this slab's vortices. Other methods start from nothing.
    """

    def __init__(self, method: ImageMethod, windows: dict[str, Any]) -> None:
        self._method, self._windows = method, windows
        self._flow: Flow | None = None
        # the pair of the slab whose wind was found from nothing: prior and noise are known there
        self._reference: VortexPairFit | None = None
        self._slab: FirstImage
        self._prepared: ExpectedFlow | None = None
        self._clock = clock_of(windows.get("device", "cpu"))

    def forget(self) -> None:
        """Start from nothing again."""
        self._flow = self._reference = None

    # no derivatives are recorded, as in `Estimator.pair_of`
    @torch.inference_mode()
    def prepare(self, slab: FirstImage, before: VortexPairFit | None) -> float:
        """Do the part of the next wind that needs no second image; its duration, s.

        ``before`` is the pair found in the last slab.
        """
        began = self._clock()
        self._slab, start = slab, self._start(slab, before)
        self._prepared = (
            expected_wind(slab.image, start, slab.noise, self._windows.get("device", "cpu"))
            if start
            else None
        )
        return self._clock() - began

    @torch.inference_mode()
    def retrieve(self, second: xr.DataArray, complete: Complete | None = None) -> SlabWind:
        """The wind of the slab that was prepared.

        second (z, y): the slab's second image.
        complete: completes the images' wind. The next one starts from the images' wind alone.

        Returns
        -------
        SlabWind
            As from `retrieve_wind`, completed. By "variational" the attribute `from_start` of the
            images' wind says whether it was found from the last one.
        """
        began = self._clock()
        wind = self._wind(second)
        flags = limits(wind)
        seconds = {"wind": self._clock() - began}
        if complete:
            wind, more = complete(wind)
            flags += more
            seconds["combination"] = self._clock() - began - seconds["wind"]
        return SlabWind(wind, flags, seconds)

    def _wind(self, second: xr.DataArray) -> xr.Dataset:
        slab = self._slab
        options = self._windows | {"noise": slab.noise, "times": slab.times}
        images = slab.image, second, slab.dt
        if self._method != ImageMethod.VARIATIONAL:
            return retrieve_wind(*images, str(self._method), **options)
        wind, self._flow = wind_of_slab(*images, self._prepared, **options)
        if not wind.attrs["from_start"]:
            self._reference = None
        return wind

    def _start(self, slab: FirstImage, before: VortexPairFit | None) -> Flow | None:
        flow, expected = self._flow, slab.expected
        # the nodes that both scans cover change with the aircraft's place
        if flow is None or slab.image.shape != flow.windows.shape:
            return None
        if expected is None or before is None:
            return flow
        self._reference = self._reference or before
        return _shifted(flow, slab, expected, before, self._reference)


def _shifted(
    flow: Flow,
    slab: FirstImage,
    expected: VortexPairFit,
    before: VortexPairFit,
    reference: VortexPairFit,
) -> Flow:
    """The flow of the last slab at the places and with the wind of the expected pair.

    The flow moves with the mean place of both vortices; then the difference of the winds of the
    expected pair and of the moved one is added.
    """
    axes = [slab.image.coords.variables[name].values.astype(float) for name in ("z", "y")]
    z, y = map(torch.as_tensor, axes)
    step = [float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (z, y)]
    now, then, first = (torch.as_tensor(fit.parameters) for fit in (expected, before, reference))
    shift, since = (
        [float((now - other)[places].mean()) for places in _PLACES] for other in (then, first)
    )
    moved = then.clone()
    for places, by in zip(_PLACES, shift, strict=True):
        moved[places] += by
    # single precision: displacements to 1e-5 px
    at_z, at_y = torch.meshgrid(z.float(), y.float(), indexing="ij")
    new, old = (model_wind(theta.float(), at_y, at_z, expected.profile) for theta in (now, moved))
    v, w = new - old
    # displacements in px, along z first as the rows of an image
    change = torch.stack([w * slab.dt / step[0], v * slab.dt / step[1]])
    in_pixels = [[by / size for by, size in zip(s, step, strict=True)] for s in (shift, since)]
    return flow.moved(in_pixels[0], change, in_pixels[1])


class InThisProcess:
    """`SlabWinds` whose futures are done as they are returned."""

    def __init__(self, method: ImageMethod, windows: dict[str, Any]) -> None:
        self._winds = SlabWinds(method, windows)

    def prepare(self, slab: FirstImage, before: VortexPairFit | None) -> Future[float]:
        """As `SlabWinds.prepare`."""
        return _done(self._winds.prepare, slab, before)

    def forget(self) -> None:
        """As `SlabWinds.forget`."""
        self._winds.forget()

    def retrieve(self, second: xr.DataArray, complete: Complete | None = None) -> Future[SlabWind]:
        """As `SlabWinds.retrieve`."""
        return _done(self._winds.retrieve, second, complete)


def _done(function: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> Future[R]:
    """A call as a future that has its result or its exception."""
    future: Future[R] = Future()
    try:
        future.set_result(function(*arguments, **named))
    except Exception as error:  # raised by `result`, as that of another process
        future.set_exception(error)
    return future


class InOwnProcess:
    """`SlabWinds` in a process of its own, which another core runs meanwhile.

    Its numbers are those of `InThisProcess` but for rounding. The process ends with this object.
    """

    def __init__(self, method: ImageMethod, windows: dict[str, Any]) -> None:
        self._pool = loky.ProcessPoolExecutor(1, initializer=_start, initargs=(method, windows))
        # before the interpreter takes apart what the pool still needs
        weakref.finalize(self, self._pool.shutdown)
        # the imports of the new process are no part of the first wind
        self._pool.submit(_ready).result()

    def prepare(self, slab: FirstImage, before: VortexPairFit | None) -> Future[float]:
        """As `SlabWinds.prepare`."""
        return self._pool.submit(_prepare, slab, before)

    def forget(self) -> None:
        """As `SlabWinds.forget`."""
        self._pool.submit(_forget).result()

    def retrieve(self, second: xr.DataArray, complete: Complete | None = None) -> Future[SlabWind]:
        """As `SlabWinds.retrieve`."""
        return self._pool.submit(_retrieve, second, complete)


# of a process of `InOwnProcess`: the winds depend on each other, so that they stay there
_winds: SlabWinds


def without_old_garbage() -> None:
    """Exempt all present objects from garbage collection.

    A collection over all objects of the libraries takes 0.1 to 0.4 s: several periods of slabs.
    """
    gc.collect()
    gc.freeze()


def _start(method: ImageMethod, windows: dict[str, Any]) -> None:
    global _winds
    # the other core fits the vortices
    torch.set_num_threads(1)
    _winds = SlabWinds(method, windows)
    without_old_garbage()


def _ready() -> None:
    """Nothing."""


def _prepare(slab: FirstImage, before: VortexPairFit | None) -> float:
    return _winds.prepare(slab, before)


def _forget() -> None:
    _winds.forget()


def _retrieve(second: xr.DataArray, complete: Complete | None) -> SlabWind:
    return _winds.retrieve(second, complete)
