"""The stages of an experiment. What each needs, its function's signature says: see `graph`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypedDict

import xarray as xr

from lidar_mi.assessment.metrics.pointing import ScanPointing
from lidar_mi.assessment.metrics.requirements import RequirementTable
from lidar_mi.assessment.metrics.rings import RingBudget
from lidar_mi.assessment.metrics.safety import ScanSafety
from lidar_mi.atmosphere.scattering.line import Line
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.experiment.graph import Graph, Stage
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.stages.coherent_lines import check_scan, coherent_lines, passing_air
from lidar_mi.experiment.stages.error_budget import error_budgets
from lidar_mi.experiment.stages.eye_safety import scan_safety
from lidar_mi.experiment.stages.image_remarks import image_remarks
from lidar_mi.experiment.stages.line_retrieval import (
    has_profiles,
    has_slices,
    line_vortices,
    line_winds,
)
from lidar_mi.experiment.stages.lines import (
    check_lines,
    measure_lines,
    requirement_tables,
    slab_wind,
    states_of_wind,
)
from lidar_mi.experiment.stages.pointing import beam_pointing
from lidar_mi.experiment.stages.rendering import (
    check_light,
    detect_images,
    detector_noise,
    given_samples,
    gridded_scans,
    image_names,
    render_images,
    samples_by_noise,
    scan_plans,
    scattering_air,
    true_cores,
)
from lidar_mi.experiment.stages.ring_calibration import assumed_rings, calibration_file
from lidar_mi.experiment.stages.ring_images import (
    Exposure,
    RingImages,
    Rings,
    air_line,
    check_rings,
    exposure,
    images_by_content,
    render_ring_images,
    ring_image_names,
    ring_instrument,
)
from lidar_mi.experiment.stages.ring_velocities import line_of_sight_winds, ring_budget
from lidar_mi.experiment.stages.sensor import combined_wind, doppler_alone, limits_of_u
from lidar_mi.experiment.stages.sensor_cost import lidar_costs, pulses_needed
from lidar_mi.experiment.stages.simulation_noise import simulation_noise
from lidar_mi.experiment.stages.texture import texture_sweep
from lidar_mi.experiment.stages.timed_beams import line_beams
from lidar_mi.experiment.stages.volume import Volumes, check_volume, scan_volumes, volume_winds
from lidar_mi.experiment.stages.vortices import (
    VortexFits,
    combined_vectors,
    fit_pairs,
    image_vectors,
)
from lidar_mi.experiment.stages.winds import check_windows, cross_flow_winds
from lidar_mi.experiment.truth.clear_air import ClearAir, clear_air
from lidar_mi.experiment.truth.extinction import Truth, true_air
from lidar_mi.experiment.truth.flows import Flows, read_flows
from lidar_mi.experiment.truth.passing_wake import PassingWake
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.phase import Scatterer
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.experiment import Experiment

if TYPE_CHECKING:
    from lidar_mi.assessment.metrics.sensor import LidarCost
    from lidar_mi.retrieval.rings.calibration import Calibration


RING_RETRIEVAL = "doppler_retrieve"


def has_wake(experiment: Experiment) -> bool:
    """Whether a backscatter lidar observes a wake."""
    return experiment.imaged_wake is not None


def has_volume(experiment: Experiment) -> bool:
    """Whether winds are retrieved from two volumes."""
    return experiment.volume is not None


def has_sensor(experiment: Experiment) -> bool:
    """Whether both lidars work as one sensor."""
    return experiment.sensor is not None


def has_images(experiment: Experiment) -> bool:
    """Whether a backscatter lidar observes a slab of a wake."""
    return has_wake(experiment) and not has_volume(experiment)


def is_without_volume(experiment: Experiment) -> bool:
    """Whether cross-flow winds are retrieved from two images, not winds from two volumes."""
    return not has_volume(experiment)


def has_error_budget(experiment: Experiment) -> bool:
    """Whether winds are also retrieved without each cause of error."""
    return has_wake(experiment) and experiment.retrieval.error_budget


def has_image_vortices(experiment: Experiment) -> bool:
    """Whether vortex pairs are fitted to the backscatter lidar's measurements alone."""
    fitted = ImageMethod.VORTEX_FIT in experiment.retrieval.methods
    alone = experiment.volume is None and experiment.sensor is None
    return has_wake(experiment) and fitted and alone


def has_vortices(experiment: Experiment) -> bool:
    """Whether vortex pairs are fitted."""
    if experiment.wake is None or experiment.sensor is None:
        return has_image_vortices(experiment)
    fitted = ImageMethod.VORTEX_FIT in experiment.retrieval.methods
    # the wake of a turbine has no pair
    return fitted or experiment.wake.turbine is None


def has_samples_by_noise(experiment: Experiment) -> bool:
    """Whether the number of Monte Carlo samples is chosen by the noise of a detector."""
    return experiment.render.samples_per_beam == "auto" and experiment.detector is not None


def has_given_samples(experiment: Experiment) -> bool:
    """Whether the number of Monte Carlo samples is given."""
    return not has_samples_by_noise(experiment)


STAGES = (
    # the truth, the scans, the air
    Stage("footprint", Footprint, preflight=True),
    Stage("flows", read_flows, has_wake, preflight=True, timing="truth"),
    Stage("clear_air", clear_air, has_wake, preflight=True),
    Stage("truth", true_air, preflight=True, timing="truth"),
    Stage("plans", scan_plans, preflight=True, timing="truth"),
    Stage("air", scattering_air, has_wake, preflight=True),
    Stage("cores", true_cores, timing="retrieve"),
    # the backscatter lidar
    Stage("samples", given_samples, has_given_samples, on_demand=True),
    Stage("samples", samples_by_noise, has_samples_by_noise, on_demand=True),
    Stage("images", render_images, check=check_light, remarks=image_remarks, parts=image_names),
    Stage("detected", detect_images),
    Stage("scans", gridded_scans),
    Stage("wind", cross_flow_winds, is_without_volume, check=check_windows, timing="retrieve"),
    Stage("simulation_noise", simulation_noise, timing="retrieve"),
    Stage("texture_sweep", texture_sweep, is_without_volume, timing="retrieve", figure_only=True),
    Stage("detector_noise", detector_noise, is_without_volume),
    Stage("pointing", beam_pointing),
    Stage("eye_safety", scan_safety, is_without_volume),
    Stage("volumes", scan_volumes, has_volume, check=check_volume, timing="retrieve"),
    Stage("wind_volume", volume_winds, timing="retrieve"),
    Stage("error_budget", error_budgets, has_error_budget, timing="error_budget"),
    # the Doppler lidar
    Stage("air_line", air_line, preflight=True),
    Stage("rings", ring_instrument, preflight=True),
    Stage(
        "ring_images",
        render_ring_images,
        check=check_rings,
        parts=ring_image_names,
        timing="doppler_render",
    ),
    Stage("lit_rings", images_by_content),
    Stage("calibration_file", calibration_file, preflight=True),
    Stage("assumed_rings", assumed_rings, timing=RING_RETRIEVAL),
    Stage("v_los", line_of_sight_winds, timing=RING_RETRIEVAL),
    Stage("ring_budget", ring_budget, timing=RING_RETRIEVAL),
    Stage("exposure", exposure, figure_only=True),
    # the coherent lidar on the ground
    Stage("passing_air", passing_air, preflight=True, check=check_scan, timing="truth"),
    Stage("coherent_lines", coherent_lines, timing="lines"),
    Stage("line_winds", line_winds, has_profiles, timing="retrieve"),
    Stage("line_vortices", line_vortices, has_slices, timing="retrieve"),
    # the backscatter and the Doppler lidar as one sensor
    Stage("requirements", requirement_tables, has_images, preflight=True),
    Stage("slab_wind", slab_wind, has_sensor, preflight=True),
    Stage("states", states_of_wind, preflight=True),
    Stage("line_beams", line_beams, preflight=True),
    Stage("lines", measure_lines, check=check_lines, timing="sensor"),
    Stage("wind3d", combined_wind, timing="sensor"),
    Stage("u_limits", limits_of_u, timing="sensor"),
    Stage("doppler_alone", doppler_alone, timing="sensor"),
    Stage("costs", lidar_costs),
    Stage("pulses_needed", pulses_needed),
    # the vortices, fitted to the most accurate vectors available
    Stage("vectors", combined_vectors, has_sensor),
    Stage("vectors", image_vectors, has_image_vortices),
    Stage("vortices", fit_pairs, has_vortices, timing="vortex"),
)


class Results(TypedDict, total=False):
    """Results of the stages by name; absent for stages that an experiment lacks."""

    footprint: Footprint
    flows: Flows
    clear_air: ClearAir
    truth: Truth
    plans: list[ScanPlan]
    air: Scatterer
    cores: list[Core]
    samples: int
    images: dict[str, xr.Dataset]
    detected: list[xr.Dataset]
    scans: list[xr.Dataset]
    wind: xr.Dataset
    simulation_noise: xr.Dataset | None
    texture_sweep: xr.Dataset
    detector_noise: dict[str, float]
    pointing: ScanPointing | None
    eye_safety: ScanSafety | None
    volumes: Volumes
    wind_volume: xr.Dataset
    error_budget: dict[str, dict[str, float]]
    air_line: Line
    rings: Rings
    ring_images: dict[str, xr.Dataset]
    lit_rings: RingImages
    calibration_file: "Calibration | None"
    assumed_rings: Rings
    v_los: xr.Dataset
    ring_budget: RingBudget
    exposure: Exposure
    passing_air: PassingWake
    coherent_lines: xr.Dataset
    line_winds: xr.Dataset
    line_vortices: xr.Dataset
    requirements: Mapping[tuple[str, str], RequirementTable]
    slab_wind: xr.Dataset
    states: xr.Dataset
    line_beams: Beams | None
    lines: xr.Dataset
    wind3d: xr.Dataset | None
    u_limits: dict[str, float]
    doppler_alone: dict[str, xr.Dataset]
    costs: "dict[str, LidarCost]"
    pulses_needed: int | None
    vectors: xr.Dataset | None
    vortices: VortexFits


def stages_of(experiment: Experiment) -> Graph:
    """The stages of an experiment, each after those that it needs."""
    return Graph(STAGES, experiment)


def storing_stages(graph: Graph) -> list[Stage]:
    """The stages whose results are stored in parts: images of both lidars.

    An encounter has none: its images depend on the flight.
    """
    if graph.experiment.encounter is not None:
        return []
    return [stage for stage in graph if stage.parts]
