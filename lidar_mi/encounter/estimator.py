"""From two images of a slab of air to its wind and its vortices, in real time."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple

import torch
import xarray as xr

from lidar_mi.encounter.combination import Completion
from lidar_mi.encounter.doppler import LineFrames
from lidar_mi.encounter.line_speeds import LineSpeeds
from lidar_mi.encounter.slab_winds import FirstImage, InOwnProcess, InThisProcess
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.stages.winds import retrieval_device, window_settings
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST
from lidar_mi.retrieval.vortices.image_fit import detected_fit, started_fit
from lidar_mi.retrieval.vortices.pair import VortexPairFit


class SlabEstimate(NamedTuple):
    """What is estimated from the signals of a slab.

    Attributes
    ----------
    wind : Dataset or None
        As `retrieve_wind` gives it; None without a method of vectors. By "variational" its
        attribute `from_start` says whether it was found from the last one.
    pair : VortexPairFit
        Its `from_start` says whether it was found from the expected one.
    seconds : dict
        Of the parts `vortices`, `wind` and `combination` after the second image; `lines`,
        `vortices_before` and `wind_before` of the lines, the first image and the expected pair,
        before it; and `total`, from the second image to the end, with two processes less than the
        sum. Work that is not finished at the second image counts in `total`: lines are recorded
        half a period before it, the first image with the second one of the last slab, and each
        process finishes that slab first.
    lines : Dataset or None
        As `with_speeds` gives them; None without frames.
    flags : tuple of str
        Of the wind's completion.
    """

    wind: xr.Dataset | None
    pair: VortexPairFit
    seconds: dict[str, float]
    lines: xr.Dataset | None = None
    flags: tuple[str, ...] = ()


class Estimator:
    """Estimates wind and vortices from pair to pair of images, as an aircraft's computer does.

    Without an expected pair the methods start from nothing. With one they start from it, and the
    wind from the last one as well: errors are the same in a fraction of the time.

    Parameters
    ----------
    experiment : Experiment
        Its `retrieval` has the windows and the method of the wind: the most accurate one listed.
        Only "variational" has a fast form.
    vectors : bool
        Whether the wind is retrieved in addition to the vortices.
    processes : int
        2: the wind is retrieved and completed in a process of its own, while this one fits the
        vortices. The numbers are the same but for rounding. It pays where a second core is idle.
    speeds : LineSpeeds, optional
        Reads the frames of the Doppler lidar.
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
        self._speeds, self._processes = speeds, processes
        # the last slab's vortices, near which the next wind starts
        self._last: VortexPairFit | None = None
        # time that each process worked on the last slab after its second image, s
        self._busy: Sequence[float] = (0.0, 0.0)

    # no derivatives are recorded: 7 % of the time
    @torch.inference_mode()
    def pair_of(
        self,
        image1: xr.DataArray,
        image2: xr.DataArray,
        dt: float,
        noise: float | xr.DataArray | None = None,
        expected: VortexPairFit | None = None,
        *,
        times: Sequence[xr.DataArray] | None = None,
        frames: LineFrames | None = None,
        complete: Completion | None = None,
        telescope: tuple[float, float, float] | None = None,
    ) -> SlabEstimate:
        """Wind, vortices, speeds along lines of sight, and the time that each took.

        Parameters
        ----------
        image1, image2 : DataArray, dims (z, y)
        dt : float
            s.
        noise : float or DataArray, optional
            As `detected_fit` takes it.
        expected : VortexPairFit, optional
            The pair expected at mid-time, with its covariance. With slopes and a telescope the fit
            is corrected for the motion in oblique beams by wind along x.
        times : sequence of two DataArray, optional
            Of the pixels, as `fit_vortices` takes them.
        frames : LineFrames, optional
            Of the Doppler lidar, half way between both images.
        complete : Completion, optional
            Completes the images' wind with the lines.
        telescope : (float, float, float), optional
            As `fit_vortices` takes it.
        """
        seconds: dict[str, float] = {}
        first = FirstImage(image1, dt, noise, times, expected)
        wind: xr.Dataset | None = None
        lines: xr.Dataset | None = None
        flags: tuple[str, ...] = ()
        if self._speeds and frames:
            with _timed(seconds, "lines"):
                lines = self._speeds.read(frames)
        # submitted before this process fits: the other one works at the same time
        prepared = self._winds.prepare(first, self._last) if self._winds else None
        fit: Callable[[xr.DataArray], VortexPairFit] = partial(
            detected_fit,
            image1,
            dt=dt,
            noise=noise,
            times=times,
            telescope=telescope,
            device=self._device,
        )
        if expected:
            with _timed(seconds, "vortices_before"):
                fit = started_fit(
                    image1,
                    dt,
                    noise,
                    start=expected,
                    times=times,
                    telescope=telescope,
                    device=self._device,
                )
        if prepared:
            # in flight the second image comes only now
            seconds["wind_before"] = prepared.result()
        with _timed(seconds, "total"):
            completion = partial(complete, lines=lines) if complete else None
            retrieved = self._winds.retrieve(image2, completion) if self._winds else None
            with _timed(seconds, "vortices"):
                pair = fit(image2)
                if expected and expected.slopes is not None and pair.inclined is not None:
                    assert expected.slope_covariance is not None  # as the slopes
                    pair = pair.with_slopes(expected.slopes, expected.slope_covariance)
            if retrieved:
                wind, flags, parts = retrieved.result()
                seconds |= parts
        # a slab without an expected pair follows skipped ones: no work is pending
        since = self._busy if expected else (0.0, 0.0)
        self._busy = _with_delay(seconds, since, dt, self._processes)
        # a failed fit is no start for the next wind
        self._last = pair if pair.success else None
        return SlabEstimate(wind, pair, seconds, lines, flags)


def _with_delay(
    seconds: dict[str, float], since: Sequence[float], period: float, processes: int
) -> list[float]:
    """Add the delay of the processes at the second image to the total.

    A process goes on with the last slab for so many seconds `since` the first image, which came
    with that slab's second one. Then it does the work before the second image; the lines are
    recorded half a period before it. A slab delays the next one by a period at most: after a longer
    one, as from nothing, slabs are skipped.

    Returns
    -------
    list of float
        Time that each process works on the slab after its second image, s.
    """

    def of(*parts: str) -> float:
        return sum(seconds.get(part, 0.0) for part in parts)

    before = [of("vortices_before"), of("wind_before")]
    after = [of("vortices"), of("wind", "combination")]
    if processes == 1:
        # one process does the work of both, one after the other
        before, after, since = [sum(before)], [sum(after)], since[:1]
    ended = [start + work for start, work in zip(since, before, strict=True)]
    if "lines" in seconds:
        # the lines are there half a period after the first image
        ended[0] = max(ended[0], period / 2) + seconds["lines"]
    done = [max(0.0, end - period) + work for end, work in zip(ended, after, strict=True)]
    seconds["total"] += max(done) - max(after)
    return [min(one, period) for one in done] * (2 // processes)


@contextmanager
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Store the duration of the block under its name."""
    began = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - began
