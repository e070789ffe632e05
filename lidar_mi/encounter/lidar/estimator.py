"""From two images of a slab of air to its wind and its vortices, in real time."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import torch
import xarray as xr

from lidar_mi.encounter.lidar.combination import Completion
from lidar_mi.encounter.lidar.doppler import LineFrames
from lidar_mi.encounter.lidar.estimate import SKIPPED
from lidar_mi.encounter.lidar.line_speeds import LineSpeeds
from lidar_mi.encounter.lidar.slab_winds import FirstImage, InOwnProcess, InThisProcess, clock_of
from lidar_mi.experiment.stages.winds import retrieval_device, window_settings
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST
from lidar_mi.retrieval.vortices.acceptance import no_fit
from lidar_mi.retrieval.vortices.image_fit import detected_fit, started_fit
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.schema.experiment import Experiment


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Collections, of 0.1 s and more over all objects of the libraries, wait until the end."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class SlabEstimate(NamedTuple):
    """What is estimated from the signals of a slab.

    wind: as `retrieve_wind` gives it; None without a method of vectors. By "variational" its
        attribute `from_start` says whether it was found from the last one.
    pair: its `from_start` says whether it was found from the expected one.
    seconds: of the parts `vortices`, `wind` and `combination` after the second image; `lines`,
        `vortices_before` and `wind_before` of the lines, the first image and the expected pair,
        before it. Processor time of the process that works on the part, so that other work of the
        machine does not count; on a GPU elapsed time.
    lines: as `with_speeds` gives them; None without frames.
    flags: of the wind's completion.
    """

    wind: xr.Dataset | None
    pair: VortexPairFit
    seconds: dict[str, float]
    lines: xr.Dataset | None = None
    flags: tuple[str, ...] = ()


class Estimator:
    """Estimates wind and vortices from pair to pair of images, as an aircraft's computer does.

    Without an expected pair the vortices start from a detection, with one from it. The wind starts
    from the last one, moved with the expected pair if there is one: errors are the same in a
    fraction of the time.

    experiment: its `retrieval` has the windows and the method of the wind: the most accurate one
        listed. Only "variational" has a fast form.
    vectors: whether the wind is retrieved in addition to the vortices.
    processes: 2: the wind is retrieved and completed in a process of its own, while this one fits
        the vortices. The numbers are the same but for rounding. It pays where a second core is
        idle.
    speeds: reads the frames of the Doppler lidar.
    """

    def __init__(
        self,
        experiment: Experiment,
        *,
        vectors: bool = True,
        processes: int = 1,
        speeds: LineSpeeds | None = None,
    ) -> None:
        settings = experiment.retrieval
        methods = [method for method in MOST_ACCURATE_FIRST if method in settings.methods]
        self._winds: InThisProcess | InOwnProcess | None = None
        if vectors and methods:
            form = InThisProcess if processes == 1 else InOwnProcess
            self._winds = form(methods[0], window_settings(settings, experiment.device))
        self._device = retrieval_device(experiment.device)
        self._speeds = speeds
        # the vortices of the last slab whose wind was retrieved, near which the next wind starts
        self._last: VortexPairFit | None = None
        self._clock = clock_of(self._device)

    def forget(self) -> None:
        """Start from nothing again."""
        self._last = None
        if self._winds:
            self._winds.forget()

    # no derivatives are recorded: 7 % of the time
    @torch.inference_mode()
    @_without_garbage_collection()
    def pair_of(
        self,
        first: FirstImage,
        image2: xr.DataArray,
        *,
        frames: LineFrames | None = None,
        complete: Completion | None = None,
        telescope: tuple[float, float, float] | None = None,
        take: tuple[bool, bool] = (True, True),
    ) -> SlabEstimate:
        """Wind, vortices, speeds along lines of sight, and the time that each took.

        first: vortices are fitted from the pair that it expects. With its slopes and a telescope
            the fit is corrected for the motion in oblique beams by wind along x.
        image2 (z, y)
        frames: of the Doppler lidar, half way between both images.
        complete: completes the images' wind with the lines.
        telescope: as `fit_vortices` takes it.
        take: whether vortices (with the lines) and wind are estimated, see `Cores.take`.
        """
        seconds: dict[str, float] = {}
        timed = partial(_timed, seconds, clock=self._clock)
        winds = self._winds if take[1] else None
        expected = first.expected
        wind: xr.Dataset | None = None
        lines: xr.Dataset | None = None
        flags: tuple[str, ...] = ()
        if self._speeds and frames and take[0]:
            with timed("lines"):
                lines = self._speeds.read(frames)
        # submitted before this process fits: the other one works at the same time
        prepared = winds.prepare(first, self._last) if winds else None
        about = {"times": first.times, "telescope": telescope, "device": self._device}
        given: dict[str, Any] = {"dt": first.dt, "noise": first.noise, **about}
        fit: Callable[[xr.DataArray], VortexPairFit] = partial(detected_fit, first.image, **given)
        if expected and take[0]:
            with timed("vortices_before"):
                fit = started_fit(first.image, start=expected, **given)
        if prepared:
            # in flight the second image comes only now
            seconds["wind_before"] = prepared.result()
        completion = partial(complete, lines=lines) if complete else None
        retrieved = winds.retrieve(image2, completion) if winds else None
        pair = no_fit("lamb_oseen", SKIPPED)
        if take[0]:
            with timed("vortices"):
                pair = fit(image2)
                if expected and expected.slopes is not None and pair.inclined is not None:
                    assert expected.slope_covariance is not None  # as the slopes
                    pair = pair.with_slopes(expected.slopes, expected.slope_covariance)
        if retrieved:
            wind, flags, parts = retrieved.result()
            seconds |= parts
            # a failed fit is no start for the next wind
            self._last = pair if pair.success else None
        elif self._winds:
            flags = (f"wind: {SKIPPED}",)
        return SlabEstimate(wind, pair, seconds, lines, flags)


@contextmanager
def _timed(seconds: dict[str, float], part: str, clock: Callable[[], float]) -> Iterator[None]:
    """Store the duration of the block under its name."""
    began = clock()
    yield
    seconds[part] = clock() - began
