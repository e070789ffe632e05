"""Time of a run before it is started, calibrated on this machine by a probe of about a second.

Rendering is timed with the experiment's own scene and few samples. All other steps have a cost per
pixel, measured on a reference machine together with a fixed piece of work, the probe. The ratio of
the times of the probe is the factor between the machines.
"""

import functools
import time
from typing import NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.pipeline import Results, has_error_budget, has_vortices
from lidar_mi.experiment.stages.coherent_lines import line_scan
from lidar_mi.experiment.stages.rendering import IMAGES, chosen_samples, render_images
from lidar_mi.retrieval.method_names import ImageMethod, RingMethod, VolumeMethod
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.schema.experiment import Experiment

PROBE_SECONDS = 0.115
"""Processor time of `probe` when all costs below were measured."""
START = 3.0
"""Seconds: libraries, and kernels that are compiled."""
IMAGE_METHODS = {
    ImageMethod.CC: (0.07, 4.5e-6),
    ImageMethod.WS: (0.06, 4e-6),
    ImageMethod.MULTIPASS: (0.15, 1.5e-5),
    ImageMethod.VARIATIONAL: (0.08, 4.2e-5),
    ImageMethod.VORTEX_FIT: (1.0, 5e-5),
}
"""Seconds of a retrieval from one pair: fixed, and per pixel."""
BOUND = (0.05, 5e-6)
"""The bound of a pair, and its true wind."""
LEVEL = (0.08, 5e-6)
"""A level of the texture sweep, without its correlation."""
CAUSES = 5
"""Retrievals of an error budget, per method."""
VOLUME_METHODS = {VolumeMethod.CORRELATION: (0.5, 1.1e-5), VolumeMethod.VARIATIONAL: (0.5, 3.4e-5)}
"""Seconds of a retrieval from two volumes: fixed, and per voxel; strides do not matter."""
RING_IMAGE = 1.3e-6
"""Seconds of a pixel of an image of rings, without noise, of 16 samples."""
RING_CALIBRATION = 3e-6
"""Seconds of a pixel of a frame from which the instrument is calibrated."""
RING_PAIR = 4.0e-7
"""Seconds of a pixel of a noisy frame and its laser's, drawn and fitted."""
RING_PIXELS_FIT = 4e-6
"""Seconds of a pixel of a frame, fitted pixel by pixel."""
RING_PEAK = 8e-8
"""Seconds of a pixel of a frame whose peaks are found, by one method."""
RING_BOUND = 6e-6
"""Seconds of a pixel, for the bound."""
VORTICES = 2.5
COHERENT_LINE, COHERENT_TURBULENCE = 6e-6, 10.0
"""Seconds of a gate of a line of a coherent lidar; times so much in turbulence."""
COHERENT_SLICE = 0.5
"""Seconds of a vertical slice of a coherent lidar, to which vortices are fitted."""
FIGURES = {"images": 8.0, "rings": 2.5, "sensor": 2.5, "coherent": 3.0}
"""Seconds of the figures of a chapter, and its part of the report."""
FLIGHT_SLAB = 0.3
"""Seconds of the wind and the vortices of a slab in flight."""
FLIGHT_LINES = 0.3
"""Of the time of fits, for frames that are read by the score function in flight."""
FLIGHT_FIGURES = 13.0
"""Seconds of the figures, the animation and the report of a flight."""
_PROBES = 4
_SAMPLES = 1.5e6
"""Samples of the render probe, times orders: half a second."""


class Cost(NamedTuple):
    """Processor time of the parts of a run, s."""

    preparation: float
    rendering: float
    images: float
    rings: float
    lines: float
    figures: float

    @property
    def total(self) -> float:
        """Sum of all parts."""
        return START + sum(self)


def cost(experiment: Experiment, results: Results, preparation: float = 0.0) -> Cost:
    """Processor time of a run on this machine, to a factor of two.

    results: results of the stages that `lidar_mi.experiment.run.prepare` has computed.
    preparation: processor time that it took, s.
    """
    # the constants are of another machine; rendering is timed on this one
    factor = slowness()
    rendering = 2 * render_seconds(experiment, results) if experiment.imaged_wake else 0.0
    return Cost(
        preparation,
        rendering,
        factor * _images(experiment, results),
        factor * _rings(experiment),
        factor * _lines(experiment),
        factor * _figures(experiment),
    )


def flight_seconds(first: Experiment, results: Results, scans: float) -> float:
    """Processor time of a flight on this machine, to a factor of two.

    first: the images of one slab.
    results: results of the stages that `lidar_mi.experiment.run.prepare` has computed of it.
    scans: of the lidar; each is of two slabs. Flights without it take hardly any time.
    """
    factor = slowness()
    slab = factor * (FLIGHT_SLAB + FLIGHT_LINES * _lines(first))
    lidar = scans * (2 * render_seconds(first, results) + slab) if scans else 0.0
    return START + lidar + factor * FLIGHT_FIGURES


@functools.cache
def slowness() -> float:
    """Time of `probe` here over `PROBE_SECONDS`; once per process."""
    probe()  # loads libraries
    start = time.process_time()
    # the mean of several, as other programs disturb a single one
    for _ in range(_PROBES):
        probe()
    return (time.process_time() - start) / (_PROBES * PROBE_SECONDS)


def probe() -> None:
    """A fixed piece of work like that of a run: a correlation of images, and counted photons."""
    from lidar_mi.retrieval.wind.pair import retrieve_wind

    rng = np.random.default_rng(1)
    axes = {axis: (axis, np.arange(96.0), {"units": "m"}) for axis in ("z", "y")}
    image = xr.DataArray(1 + 0.1 * rng.standard_normal((96, 96)), axes, ("z", "y"))
    second = image.copy(data=np.roll(image.values, 1, 1))
    retrieve_wind(image, second, dt=0.1, method=ImageMethod.CC)
    rng.poisson(np.full((500, 800), 30.0))


def render_seconds(experiment: Experiment, results: Results) -> float:
    """Time of one image, from the first one with few samples and with four times as many.

    Their difference excludes work that is done once, such as compiling. If the number of samples is
    chosen, the time of the choice is included.
    """
    plan, render = results["plans"][0], experiment.render
    inputs = {name: results[name] for name in ("truth", "plans", "air", "flows")}
    if render.samples_per_beam == "auto":
        begin = time.process_time()
        number = render.without_detector(plan.gate_count)
        if experiment.detector:
            number = call(chosen_samples, experiment, **inputs).number
        choosing = time.process_time() - begin
        # callers time two images, which share one choice
        return choosing / 2 + render_seconds(with_number(experiment, number), results)
    beams, least = plan.y.size * plan.z.size, 2 * experiment.scan.gate_count
    few = max(2, least, round(_SAMPLES / 4 / (beams * render.max_order)))
    whole = max(render.samples_per_beam, least)

    def timed(samples: int) -> float:
        start = time.process_time()
        rendered = call(render_images, experiment, **inputs, samples=samples, missing=IMAGES[:1])
        for _ in rendered:
            pass
        return time.process_time() - start

    # the first image also loads and compiles, which is not part of an image's time
    if whole <= 4 * few:
        timed(whole)
        return timed(whole)
    timed(few)
    short, long = timed(few), timed(4 * few)
    # linear in the samples; disturbed times may make the longer image the faster one
    return short + max(long - short, 0.0) * (whole - few) / (3 * few)


def with_number(experiment: Experiment, samples: int) -> Experiment:
    """The experiment with a number of samples per beam."""
    render = experiment.render.model_copy(update={"samples_per_beam": samples})
    changed = experiment.model_copy(update={"render": render})
    return changed.read_from(experiment.folder)


def _images(experiment: Experiment, results: Results) -> float:
    """Winds from images or volumes."""
    if not experiment.imaged_wake:
        return 0.0
    plan = results["plans"][0]
    pixels = plan.y.size * plan.z.size
    if experiment.volume:
        voxels = pixels * experiment.scan.gate_count
        return sum(_at(VOLUME_METHODS[method], voxels) for method in experiment.volume.methods)
    settings = experiment.retrieval
    each = sum(_at(IMAGE_METHODS[method], pixels) for method in settings.methods)
    everything = settings.sources == "all"
    # extinction, without texture, blurred, backscatter; and the noisy one
    sources = (4 if everything else 1) + bool(experiment.detector and everything)
    seconds = 1.0 + sources * (each + _at(BOUND, pixels))
    # the levels of the texture sweep
    seconds += 6 * (_at(IMAGE_METHODS[ImageMethod.CC], pixels) + _at(LEVEL, pixels))
    if has_error_budget(experiment):
        seconds += CAUSES * each
    return seconds + VORTICES * has_vortices(experiment)


def _rings(experiment: Experiment) -> float:
    """Images of rings, and velocities from them."""
    doppler = experiment.fringes
    if not doppler:
        return 0.0
    settings, pixels = doppler.retrieval, doppler.camera.width * doppler.camera.height
    cases = len(settings.averaged) * len(doppler.v_los)
    slow = cases * settings.slow_images * len(settings.centre)
    calibration = doppler.calibration
    calibrated = 0 if calibration is None or calibration.file else calibration.frames
    peaks = [m for m in settings.methods if m not in (RingMethod.ANNULAR, RingMethod.PIXELS)]
    return pixels * (
        RING_IMAGE * (len(doppler.v_los) + 1) * doppler.render.samples_per_pixel / 16
        + RING_CALIBRATION * calibrated
        + RING_PAIR * cases * settings.images
        + RING_PIXELS_FIT * slow * (RingMethod.PIXELS in settings.methods)
        + RING_PEAK * slow * len(peaks)
        + RING_BOUND
    )


def _lines(experiment: Experiment) -> float:
    """All lines of sight; the pulses of a line are summed, however many they are."""
    if experiment.coherent:
        return _coherent(experiment.coherent)
    sensor, doppler = experiment.sensor, experiment.fringes
    if sensor is None or doppler is None:
        return 0.0
    directions, camera = sensor.directions, doppler.camera
    return RING_PAIR * directions.columns * directions.rows * camera.width * camera.height


def _coherent(doppler: CoherentDoppler) -> float:
    """Lines of a coherent lidar, and the fits to its slices."""
    lines = line_scan(doppler.scan).time.size
    gusts = COHERENT_TURBULENCE if doppler.air.turbulence else 1.0
    slices = doppler.scan.count if doppler.scan.kind == "rhi" else 0
    return gusts * COHERENT_LINE * lines * doppler.laser.gates + COHERENT_SLICE * slices


def _figures(experiment: Experiment) -> float:
    parts = {
        "images": experiment.imaged_wake,
        "rings": experiment.fringes,
        "sensor": experiment.sensor,
        "coherent": experiment.coherent,
    }
    return sum(FIGURES[name] for name, present in parts.items() if present)


def _at(line: tuple[float, float], pixels: float) -> float:
    return line[0] + line[1] * pixels
