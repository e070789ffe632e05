"""The error budget of an experiment's cross-flow wind: retrieved without each cause of error."""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.cores import Core, find_cores
from lidar_mi.assessment.metrics.error_budget import (
    error_budget,
    image_scale,
    images_without,
    moved_rigidly,
)
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.atmosphere.advection import advect
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.stages.winds import (
    known_blur,
    pixel_times,
    rendered_pairs,
    window_settings,
)
from lidar_mi.experiment.truth import Truth, blur_by_beam
from lidar_mi.retrieval.velocimetry.wind import retrieve_wind

# Images of air without blur: a method that corrects for the beam's blur has none to correct there.
_SHARP = ("perfect", "beam_blur")
# Images made of the rendered ones, whose pixels may have times; the others are photographs.
_RENDERED = ("measured", "detector_noise", "beam_blur", "slab")


def error_budgets(
    experiment: Experiment,
    truth: Truth,
    scans: Sequence[xr.Dataset],
    wind: xr.Dataset,
    cores: Sequence[Core],
    *,
    log: Log,
) -> dict[str, dict[str, float]]:
    """`budgets` from a run's winds, where these need not be retrieved again."""
    log("retrieving winds without each cause of error")
    return budgets(experiment, truth, scans, log.bar, wind, cores)


def budgets(
    experiment: Experiment,
    truth: Truth,
    scans,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    known: xr.Dataset | None = None,
    cores: Sequence[Core] | None = None,
    flagged: bool = False,
) -> dict[str, dict[str, float]]:
    """`error_budget` of every method of an experiment, by method.

    Parameters
    ----------
    scans : the two rendered scans
    progress : callable, optional
        Called with the name of the step and the fraction done.
    known : xr.Dataset, optional
        Winds that need not be retrieved again, from
        `lidar_mi.experiment.stages.winds.cross_flow_winds`.
    cores, flagged : optional
        See `error_budget`; cores left out: those of the true wind.
    """
    images, blurred = _images(experiment, truth, scans)
    times = pixel_times(experiment, scans)
    cores = find_cores(truth.wind) if cores is None else cores
    methods = experiment.retrieval.methods
    settings = {"dt": experiment.platform.dt, **window_settings(experiment.retrieval)}
    blur = known_blur(experiment, scan_plans(experiment, truth)[0])
    sources = {"measured": Source.BACKSCATTER, "perfect": Source.EXTINCTION}
    if experiment.detector:
        sources |= {"measured": Source.NOISY, "detector_noise": Source.BACKSCATTER}
    found = {}
    for index, method in enumerate(methods):
        progress(f"retrieving without each cause of error, {method}", index / len(methods))
        winds = {}
        for cause, (pair, noise) in images.items():
            source = sources.get(cause)
            if known is not None and source:
                kept = known.sel(source=source, algorithm=method)
                winds[cause] = kept.assign_attrs(method=method, **settings)
            else:
                corrected = 0.0 if cause in _SHARP else blur
                # the flags that count are those of the images as measured
                flags = dict.fromkeys(("checks", "standard_errors"), cause == "measured")
                winds[cause] = retrieve_wind(
                    *pair,
                    method=method,
                    noise=noise,
                    blur=corrected,
                    times=times if cause in _RENDERED else None,
                    **flags,
                    **settings,
                )
        measured, perfect = winds.pop("measured"), winds.pop("perfect")
        stiff = moved_rigidly(
            measured,
            images["measured"][0],
            blurred,
            truth.wind,
            lambda pair, stride, method=method: retrieve_wind(
                *pair,
                method=method,
                checks=False,
                standard_errors=False,
                **settings | {"stride": stride},
            ),
        )
        winds |= {} if stiff is None else {"shear": stiff}
        found[method] = error_budget(measured, winds, truth.wind, cores, perfect, flagged)
    return found


def _images(experiment, truth, scans) -> tuple[dict[str, tuple], list[xr.DataArray]]:
    """Images and their noise: as measured, without each cause, and of the air itself.

    Also the air averaged over the beams.
    """
    rendered = rendered_pairs(experiment, scans)
    pair, noise = rendered[Source.BACKSCATTER]
    measured, level = rendered.get(Source.NOISY, (pair, noise))
    gain = offset = None

    def as_measured(images, blurred=True):
        """Extinction as the lidar would measure it without noise, on the images' grid."""
        depth = experiment.scan.thickness / experiment.scan.gate_count
        if blurred:
            images = [
                blur_by_beam(image, experiment.lidar, plan.centre, depth)
                for image, plan in zip(images, scan_plans(experiment, truth), strict=True)
            ]
        if experiment.scan.aim == "angles":
            images = [image.interp(y=pair[0]["y"], z=pair[0]["z"]) for image in images]
        return images if gain is None else [gain * image + offset for image in images]

    air = [truth.image(k) for k in (0, 1)]
    noises = [xr.zeros_like(image) + noise for image in pair]
    gain, offset = image_scale(as_measured(air), pair, noises)
    advected = None
    if truth.extinction[0].sizes["x"] > 1 or experiment.wake.second != "advect":
        moved = advect(air[0], truth.wind["v"], truth.wind["w"], experiment.platform.dt)
        advected = as_measured([air[0], moved])
    sharp = as_measured(air, blurred=False)
    blurred = as_measured(air)
    without = images_without(
        measured, blurred, sharp, pair if experiment.detector else None, advected
    )
    # without the simulation's noise the detector's remains, if there is one
    counts = np.sqrt(np.maximum(level**2 - noise**2, 0)) if experiment.detector else 0.0
    levels = {"detector_noise": noise, "monte_carlo": counts}
    return {
        "measured": (measured, level),
        "perfect": (sharp, 0.0),
        **{cause: (images, levels.get(cause, level)) for cause, images in without.items()},
    }, blurred
