"""The stages of an experiment and their dependencies."""

from collections.abc import Callable
from typing import Any

from lidar_mi.experiment.graph import Stage, in_order
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.stages.error_budget import error_budgets
from lidar_mi.experiment.stages.eye_safety import scan_safety
from lidar_mi.experiment.stages.image_remarks import image_remarks
from lidar_mi.experiment.stages.lines import (
    check_lines,
    measure_lines,
    requirement_tables,
    slab_wind,
    states_of_wind,
)
from lidar_mi.experiment.stages.pointing import beam_pointing
from lidar_mi.experiment.stages.rendering import (
    IMAGES,
    check_light,
    detect_images,
    detector_noise,
    gridded_scans,
    read_truth,
    render_images,
    scan_plans,
    scattering_air,
    true_cores,
)
from lidar_mi.experiment.stages.ring_calibration import assumed_rings, calibration_file
from lidar_mi.experiment.stages.ring_images import (
    check_rings,
    exposure,
    render_ring_images,
    ring_image_names,
    ring_images,
    ring_instrument,
)
from lidar_mi.experiment.stages.ring_velocities import line_of_sight_winds, ring_budget
from lidar_mi.experiment.stages.sensor import combined_wind, doppler_alone, limits_of_u
from lidar_mi.experiment.stages.sensor_cost import lidar_costs, pulses_needed
from lidar_mi.experiment.stages.simulation_noise import simulation_noise
from lidar_mi.experiment.stages.texture import texture_sweep
from lidar_mi.experiment.stages.timed_beams import line_beams
from lidar_mi.experiment.stages.volume import check_volume, scan_volumes, volume_winds
from lidar_mi.experiment.stages.vortices import combined_vectors, fit_pairs, image_vectors
from lidar_mi.experiment.stages.winds import check_windows, cross_flow_winds
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.retrieval.method_names import ImageMethod

GIVEN = ("beside",)
"""Given from the start: the folder in which files of an experiment are searched first."""

RING_RETRIEVAL = "doppler_retrieve"


def has_wake(experiment: Experiment) -> bool:
    """Whether a backscatter lidar observes a wake."""
    return experiment.wake is not None


def has_images(experiment: Experiment) -> bool:
    """Whether cross-flow winds are retrieved from the two images."""
    return has_wake(experiment) and experiment.volume is None


def has_volume(experiment: Experiment) -> bool:
    """Whether winds are retrieved from two volumes."""
    return experiment.volume is not None


def has_detector(experiment: Experiment) -> bool:
    """Whether the backscatter lidar has a detector whose noise is simulated."""
    return has_images(experiment) and experiment.detector is not None


def has_error_budget(experiment: Experiment) -> bool:
    """Whether winds are also retrieved without each cause of error."""
    return has_wake(experiment) and experiment.retrieval.error_budget


def has_rings(experiment: Experiment) -> bool:
    """Whether there is a Doppler lidar."""
    return experiment.doppler is not None


def has_sensor(experiment: Experiment) -> bool:
    """Whether both lidars work as one sensor."""
    return experiment.sensor is not None


def has_vortices_without_sensor(experiment: Experiment) -> bool:
    """Whether vortex pairs are fitted to the backscatter lidar's measurements alone."""
    fitted = has_images(experiment) and ImageMethod.VORTEX_FIT in experiment.retrieval.methods
    return fitted and not has_sensor(experiment)


def has_vortices(experiment: Experiment) -> bool:
    """Whether vortex pairs are fitted."""
    asked = ImageMethod.VORTEX_FIT in experiment.retrieval.methods
    # the wake of a turbine has no pair
    pair = has_sensor(experiment) and (asked or not experiment.wake.turbine)
    return pair or has_vortices_without_sensor(experiment)


def _quiet(function: Callable[..., Any]) -> Callable[..., Any]:
    """A stage's ``compute`` from a function without a log."""
    return lambda *needed, log: function(*needed)


BEHIND_IMAGES = ("name", "lidar.pulse_energy", "detector", "retrieval", "doppler", "sensor")
"""What is used only after the backscatter lidar's images, which are per emitted energy."""


def needed_by_samples(experiment: Experiment) -> tuple[str, ...]:
    """Keys that determine how many samples images have, where that is chosen by the noise."""
    if experiment.render.samples_per_beam != "auto":
        return ()
    return ("detector", "lidar.pulse_energy") if experiment.detector else ("detector",)


BEHIND_RING_IMAGES = (
    "name",
    "wake",
    "platform",
    "lidar",
    "detector",
    "scan",
    "scattering",
    "render",
    "retrieval",
    "sensor",
    "volume",
    "doppler.lidar.pulse_energy",
    "doppler.lidar.pulse_duration",
    "doppler.lidar.beam_radius",
    "doppler.lidar.divergence_full",
    "doppler.lidar.telescope_area",
    "doppler.lidar.fov_half",
    "doppler.lidar.instrument_constant",
    "doppler.lidar.counted",
    "doppler.lidar.range",
    "doppler.lidar.range_bin",
    "doppler.lidar.backscatter",
    "doppler.lidar.extinction",
    "doppler.lidar.sky_radiance",
    "doppler.lidar.filter_bandwidth",
    "doppler.ccd",
    "doppler.speckle_modes",
    "doppler.reference",
    "doppler.assumed",
    "doppler.calibration",
    "doppler.retrieval",
)
"""What is used beside or after the Doppler lidar's images, which are in relative units."""

STAGES = (
    # the truth, the scans, the air
    Stage(
        "flows",
        read_truth,
        ("beside",),
        has_wake,
        ahead=True,
        timing="truth",
        indifferent_to=BEHIND_IMAGES,
    ),
    Stage(
        "truth",
        _quiet(make_truth),
        ("beside", "flows"),
        has_wake,
        ahead=True,
        timing="truth",
        indifferent_to=BEHIND_IMAGES,
    ),
    Stage(
        "plans",
        _quiet(scan_plans),
        ("truth", "beside"),
        has_wake,
        ahead=True,
        timing="truth",
        indifferent_to=BEHIND_IMAGES,
    ),
    Stage("air", scattering_air, ("beside",), has_wake, ahead=True, indifferent_to=BEHIND_IMAGES),
    Stage("cores", _quiet(true_cores), ("truth",), has_wake, timing="retrieve"),
    # the backscatter lidar
    Stage(
        "images",
        render_images,
        ("truth", "plans", "air", "flows"),
        has_wake,
        check=check_light,
        remarks=image_remarks,
        parts=lambda experiment: IMAGES,
        indifferent_to=BEHIND_IMAGES,
        needed_by=needed_by_samples,
    ),
    Stage("detected", _quiet(detect_images), ("images", "plans"), has_wake),
    Stage("scans", _quiet(gridded_scans), ("detected",), has_wake),
    Stage(
        "wind",
        cross_flow_winds,
        ("truth", "plans", "scans"),
        has_images,
        check=check_windows,
        timing="retrieve",
    ),
    Stage(
        "simulation_noise",
        simulation_noise,
        ("detected", "plans", "scans", "wind"),
        has_images,
        timing="retrieve",
    ),
    Stage(
        "texture_sweep", texture_sweep, ("flows",), has_images, timing="retrieve", illustrates=True
    ),
    Stage("detector_noise", _quiet(detector_noise), ("detected",), has_detector),
    Stage("pointing", _quiet(beam_pointing), ("plans",), has_wake),
    Stage("eye_safety", _quiet(scan_safety), ("plans", "beside"), has_images),
    Stage(
        "volumes",
        _quiet(scan_volumes),
        ("flows", "plans", "scans"),
        has_volume,
        check=check_volume,
        timing="retrieve",
    ),
    Stage("wind_volume", volume_winds, ("flows", "volumes"), has_volume, timing="retrieve"),
    Stage(
        "error_budget",
        error_budgets,
        ("truth", "flows", "scans", "wind", "cores", "beside"),
        has_error_budget,
        timing="error_budget",
    ),
    # the Doppler lidar
    Stage("rings", _quiet(lambda asked: ring_instrument(asked.doppler)), (), has_rings, ahead=True),
    Stage(
        "ring_images",
        render_ring_images,
        ("rings",),
        has_rings,
        check=check_rings,
        parts=ring_image_names,
        timing="doppler_render",
        indifferent_to=BEHIND_RING_IMAGES,
    ),
    Stage("lit_rings", _quiet(ring_images), ("ring_images",), has_rings),
    Stage("calibration_file", calibration_file, ("rings", "beside"), has_rings, ahead=True),
    Stage(
        "assumed_rings",
        assumed_rings,
        ("rings", "calibration_file"),
        has_rings,
        timing=RING_RETRIEVAL,
    ),
    Stage(
        "v_los",
        line_of_sight_winds,
        ("assumed_rings", "lit_rings"),
        has_rings,
        timing=RING_RETRIEVAL,
    ),
    Stage("ring_budget", ring_budget, ("rings", "lit_rings"), has_rings, timing=RING_RETRIEVAL),
    Stage("exposure", _quiet(exposure), ("rings", "lit_rings"), has_rings, illustrates=True),
    # both as one sensor
    Stage("requirements", _quiet(requirement_tables), ("beside",), has_sensor, ahead=True),
    Stage("slab_wind", _quiet(slab_wind), ("truth",), has_sensor, ahead=True),
    Stage("states", _quiet(states_of_wind), ("slab_wind", "flows"), has_sensor, ahead=True),
    Stage("line_beams", _quiet(line_beams), ("beside",), has_sensor, ahead=True),
    Stage(
        "lines",
        measure_lines,
        ("states", "rings", "line_beams", "assumed_rings"),
        has_sensor,
        check=check_lines,
        timing="sensor",
    ),
    Stage("wind3d", combined_wind, ("slab_wind", "lines", "wind"), has_sensor, timing="sensor"),
    Stage(
        "u_limits",
        _quiet(limits_of_u),
        ("slab_wind", "lines", "wind", "wind3d", "cores", "line_beams", "states"),
        has_sensor,
        timing="sensor",
    ),
    Stage("doppler_alone", doppler_alone, ("lines",), has_sensor, timing="sensor"),
    Stage("costs", _quiet(lidar_costs), ("slab_wind", "beside"), has_sensor),
    Stage("pulses_needed", _quiet(pulses_needed), ("requirements", "lines"), has_sensor),
    # the vortices, fitted to the most accurate vectors available
    Stage("vectors", _quiet(combined_vectors), ("wind3d",), has_sensor),
    Stage("vectors", _quiet(image_vectors), ("wind",), has_vortices_without_sensor),
    Stage("vortices", fit_pairs, ("plans", "scans", "vectors"), has_vortices, timing="vortex"),
)


def stages_of(experiment: Experiment) -> list[Stage]:
    """The stages of an experiment, each behind those it needs."""
    return in_order([stage for stage in STAGES if stage.wanted(experiment)], GIVEN)


def storing_stages(experiment: Experiment) -> list[Stage]:
    """The stages of an experiment whose results are stored in parts: images of both lidars.

    An encounter has none: its images depend on the flight.
    """
    if experiment.encounter is not None:
        return []
    return [stage for stage in stages_of(experiment) if stage.parts]
