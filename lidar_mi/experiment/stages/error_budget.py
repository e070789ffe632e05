"""The error budget of an experiment's cross-flow wind: retrieved without each cause of error."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi.assessment.metrics.error_budget import (
    error_budget,
    image_scale,
    images_without,
    moved_rigidly,
)
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.atmosphere.advection import advect, advect_to
from lidar_mi.atmosphere.vortices.cores import Core, find_cores
from lidar_mi.experiment.graph import bundle, call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.ideal_images import ideal_scan, slab_images
from lidar_mi.experiment.stages.image_pair import noise_without
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.stages.winds import (
    known_blur,
    pixel_times,
    rendered_pairs,
    window_settings,
    window_sizes,
)
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows, flows_of
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.motion import Motion
from lidar_mi.instrument.reported import Reported
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.retrieval import Retrieval

# Images of air without blur: a method that corrects for the beam's blur has none to correct there.
_SHARP = ("perfect", "beam_blur")
Times = list[xr.DataArray] | None


@bundle
class _Sensor:
    """The air and the backscatter lidar: what images without a cause of error differ in."""

    observation: Observation
    lidar: BackscatterLidar
    detector: Detector | None
    seed: int
    search_path: Path
    device: str | None = None

    def plans(self, truth: Truth) -> list[ScanPlan]:
        """The scans of both images."""
        scan, platform = self.observation.scan, self.observation.platform
        return scan_plans(scan, platform, self.seed, truth, self.search_path)

    def on(self, platform: Platform) -> "_Sensor":
        """The same on another platform."""
        return replace(self, observation=replace(self.observation, platform=platform))


@dataclass(frozen=True)
class _Images:
    """An image pair, its noise (a map or its level), and the times of its pixels if they differ."""

    pair: Sequence[xr.DataArray]
    noise: xr.DataArray | float
    times: Times = None


def error_budgets(
    sensor: _Sensor,
    retrieval: Retrieval,
    flows: Flows,
    truth: Truth,
    scans: Sequence[xr.Dataset],
    wind: xr.Dataset,
    cores: Sequence[Core],
    log: Log,
) -> dict[str, dict[str, float]]:
    """`budgets` from a run's winds, where these need not be retrieved again."""
    log("retrieving winds without each cause of error")
    cases = _winds_without(sensor, retrieval, truth, scans, flows, log.bar, wind)
    return {method: _budget(winds, truth, cores) for method, winds in cases}


def budgets(
    experiment: Experiment,
    truth: Truth,
    scans: Sequence[xr.Dataset],
    cores: Sequence[Core] | None = None,
    flagged: bool = False,
) -> dict[str, dict[str, float]]:
    """`error_budget` of every method of an experiment, by method.

    Without cores: those of the true wind.
    """
    flows = flows_of(experiment) if experiment.scan.air == "moving" else None
    cores = find_cores(truth.wind) if cores is None else cores
    cases = _winds_without(call(_Sensor, experiment), experiment.retrieval, truth, scans, flows)
    return {method: _budget(winds, truth, cores, flagged) for method, winds in cases}


def _budget(
    winds: dict[str, xr.Dataset], truth: Truth, cores: Sequence[Core], flagged: bool = False
) -> dict[str, float]:
    measured, perfect = winds.pop("measured"), winds.pop("perfect")
    return error_budget(measured, winds, truth.wind, cores, perfect, flagged)


def _winds_without(
    sensor: _Sensor,
    retrieval: Retrieval,
    truth: Truth,
    scans: Sequence[xr.Dataset],
    flows: Flows | None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    known: xr.Dataset | None = None,
) -> Iterator[tuple[ImageMethod, dict[str, xr.Dataset]]]:
    """Winds by every method, of the images as measured, without each cause, and perfect ones.

    Those that are known, from `cross_flow_winds`, are not retrieved again.
    """
    from lidar_mi.retrieval.wind.pair import retrieve_wind

    plans = sensor.plans(truth)
    images, blurred = _images(sensor, truth, flows, plans, scans)
    methods = retrieval.methods
    dt, sizes = sensor.observation.platform.dt, window_sizes(retrieval)
    settings: dict[str, Any] = {"dt": dt, **window_settings(retrieval, sensor.device)}
    blur = known_blur(retrieval, sensor.lidar, plans[0])
    sources = {"measured": Source.BACKSCATTER, "perfect": Source.EXTINCTION}
    if sensor.detector:
        sources |= {"measured": Source.NOISY, "detector_noise": Source.BACKSCATTER}
    for index, method in enumerate(methods):
        progress(f"retrieving without each cause of error, {method}", index / len(methods))
        winds = {}
        for cause, case in images.items():
            source = sources.get(cause)
            # the run has winds from these images
            if known is not None and source:
                retrieved = known.sel(source=source, algorithm=method)
                winds[cause] = retrieved.assign_attrs(method=method, dt=dt, **asdict(sizes))
            else:
                corrected = 0.0 if cause in _SHARP else blur
                # the flags that count are those of the images as measured
                flags: dict[str, Any]
                flags = dict.fromkeys(("checks", "standard_errors"), cause == "measured")
                winds[cause] = retrieve_wind(
                    case.pair[0],
                    case.pair[1],
                    method=method,
                    noise=case.noise,
                    blur=corrected,
                    times=case.times,
                    **flags,
                    **settings,
                )
        # windows that move rigidly are photographs from where they were reported
        if all(plan.beams is None for plan in plans):

            def at_stride(
                pair: Sequence[xr.DataArray], stride: int, method: ImageMethod = method
            ) -> xr.Dataset:
                return retrieve_wind(
                    pair[0],
                    pair[1],
                    method=method,
                    checks=False,
                    standard_errors=False,
                    **settings | {"windows": replace(sizes, stride=stride)},
                )

            pair = images["measured"].pair
            stiff = moved_rigidly(winds["measured"], pair, blurred, truth.wind, at_stride)
            winds |= {} if stiff is None else {"shear": stiff}
        yield method, winds


def _images(
    sensor: _Sensor,
    truth: Truth,
    flows: Flows | None,
    plans: Sequence[ScanPlan],
    scans: Sequence[xr.Dataset],
) -> tuple[dict[str, _Images], list[xr.DataArray]]:
    """Images as measured, without each cause, and of the air itself, by cause.

    Also the air averaged over the beams.
    """
    observation = sensor.observation
    wake, scan, platform = observation.wake, observation.scan, observation.platform
    rendered = rendered_pairs(wake, scan, scans)
    pair, noise = rendered[Source.BACKSCATTER]
    measured, level = rendered.get(Source.NOISY, (pair, noise))
    air = slab_images(observation, truth, flows, plans)
    noises = [xr.zeros_like(image) + noise for image in pair]
    ideal, _ = _without_noise(sensor, air, plans, pair)
    # one scale of all cases, so that they differ by their cause alone
    gain, offset = image_scale(ideal, pair, noises)

    def as_measured(
        air: Sequence[xr.DataArray], of: Sequence[ScanPlan] = plans, blurred: bool = True
    ) -> list[xr.DataArray]:
        """Extinction as the lidar would measure it without noise, on the images' grid."""
        images, _ = _without_noise(sensor, air, of, pair, blurred)
        return [gain * image + offset for image in images]

    advected = None
    # a single plane that its own flow advects has no out-of-plane motion to leave out
    if truth.extinction[0].sizes["x"] > 1 or wake.second != "advect":
        advected = as_measured(_advected_by_the_mean(platform.dt, truth, air))
    photographs = [truth.image(k) for k in (0, 1)]
    blurred = as_measured(air)
    timed: dict[str, list[xr.DataArray]] = {}
    times: dict[str, Times] = {}
    if any("time" in image.dims for image in air):
        timed["scan_time"], times["scan_time"] = as_measured(photographs), None
    for cause, without_it in platforms_without(platform).items():
        other = sensor.on(without_it)
        its_plans = other.plans(truth)
        its_air = slab_images(other.observation, truth, flows, its_plans)
        timed[cause] = as_measured(its_air, its_plans)
        times[cause] = _without_noise(other, its_air, its_plans, pair)[1]
    without = images_without(
        measured,
        blurred,
        as_measured(air, blurred=False),
        pair if sensor.detector else None,
        advected,
        timed,
    )
    # without the simulation's noise the detector's remains, if there is one
    counts = noise_without(level, noise) if sensor.detector else 0.0
    levels = {"detector_noise": noise, "monte_carlo": counts}
    known = pixel_times(wake, scan, scans)
    on_grid = _on_grid(scan, photographs, pair)
    sharp = [gain * image + offset for image in on_grid]
    return {
        "measured": _Images(measured, level, known),
        "perfect": _Images(sharp, 0.0),
        **{
            cause: _Images(images, levels.get(cause, level), times.get(cause, known))
            for cause, images in without.items()
        },
    }, blurred


def platforms_without(platform: Platform) -> dict[str, Platform]:
    """The platform without each of its causes of error, by cause; those that it has.

    Errors of the reported pose that come from its age are zero without motion. Random numbers of
    the other causes are the same.
    """
    platforms = {}
    motion, reported = platform.motion or Motion(), platform.reported or Reported()
    # jitter is a cause of its own, which stays without motion
    still = Motion().model_copy(update={"scanner_jitter": motion.scanner_jitter})
    if motion != still:
        platforms["motion"] = platform.model_copy(update={"motion": still})
    if motion.scanner_jitter > 0:
        steady = motion.model_copy(update={"scanner_jitter": 0.0})
        platforms["scanner_jitter"] = platform.model_copy(update={"motion": steady})
    if reported != Reported():
        platforms["navigation"] = platform.model_copy(update={"reported": None})
    return platforms


def _without_noise(
    sensor: _Sensor,
    air: Sequence[xr.DataArray],
    plans: Sequence[ScanPlan],
    like: Sequence[xr.DataArray],
    blurred: bool = True,
) -> tuple[list[xr.DataArray], Times]:
    """The air as both scans see it, and the times of pixels where they are of their own air."""
    from lidar_mi.retrieval.images.common_grid import resample_pair
    from lidar_mi.retrieval.wind.synchronised import synchronised

    wake, scan = sensor.observation.wake, sensor.observation.scan
    depth = scan.thickness / scan.gate_count
    lidar = sensor.lidar if blurred else None
    if all(plan.beams is None for plan in plans):
        images = list(air)
        if lidar is not None:
            images = [
                blur_by_beam(image, lidar, plan.centre, depth)
                for image, plan in zip(images, plans, strict=True)
            ]
        return _on_grid(scan, images, like), None
    scans = [
        ideal_scan(image, plan, lidar, depth, gridded=False).assign_attrs(
            frozen_air=int(scan.air == "frozen")
        )
        for image, plan in zip(air, plans, strict=True)
    ]
    scans = synchronised(scans, [sensor.observation.platform.dt], "Y")
    images = [one["Y"] for one in scans]
    if scan.aim == "angles":
        images = list(resample_pair(images[0], images[1], wake.spacing))
    return images, pixel_times(wake, scan, scans)


def _on_grid(
    scan: Scan, images: Sequence[xr.DataArray], like: Sequence[xr.DataArray]
) -> list[xr.DataArray]:
    """Images of the wake's grid on the grid of the measured ones."""
    if scan.aim == "grid":
        return list(images)
    return [image.interp(y=like[0]["y"], z=like[0]["z"]) for image in images]


def _advected_by_the_mean(
    dt: float, truth: Truth, air: Sequence[xr.DataArray]
) -> list[xr.DataArray]:
    """The first scan's air, at its reference time, moved with the slab's mean wind."""
    start, v, w = truth.image(0), truth.wind["v"], truth.wind["w"]
    return [
        advect_to(start, v, w, image["time"].values + which * dt)
        if "time" in image.dims
        else (advect(start, v, w, dt) if which else start)
        for which, image in enumerate(air)
    ]
