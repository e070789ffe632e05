"""Estimates before a run: its memory, and whether its images will have light."""

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.wake import MOST_NODES
from lidar_mi.errors import InputError
from lidar_mi.experiment.schema import Experiment
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.io.exr import MOST_LAYERS
from lidar_mi.rendering.memory import (
    PER_PIXEL,
    PER_SAMPLE,
    PROGRAM,
    ceiling,
    check_memory,
    image_bytes,
    samples_at_once,
)
from lidar_mi.units import shown

PER_NODE = 160
"""Bytes of a node of the wake: twenty fields in double precision."""
PER_VECTOR = 400
"""Bytes of a vector, per method and source: 25 variables, twice where they are concatenated."""
PER_VOXEL = 200
"""Bytes of a voxel of a volume whose wind is retrieved."""
SINGLE = 1e-17
"""S0 whose squared error is the smallest number of single precision."""
CONTRIBUTIONS = 5
"""Contributing samples required per pixel, on average: 0.7 % of all pixels then have none."""


PER_SPEED = 160
"""Bytes of a pixel of the fringe camera, for every speed but the first; measured: 157."""
PER_STATE = 34
"""Bytes of a value of moving air's states: three arrays in double precision while they are made,
two scans in single precision with what is mixed of them; measured, with molecules."""


def forecast(experiment: Experiment, beams: int, in_states: int = 0) -> float:
    """Memory of a run in bytes, to a factor of two.

    Parameters
    ----------
    beams : int
        Of the backscatter lidar in an image; 0: there is none.
    in_states : int
        Values of all states of moving air in a scan, see `truth_in_time.values_of_states`.
    """
    rings = _of_rings(experiment)
    if not beams:
        return PROGRAM + rings
    render, gates = experiment.render, experiment.scan.gate_count
    samples = beams * max(most_samples(experiment, beams), 2 * gates)
    at_once = samples_at_once(render.samples_per_pass, render.memory)
    images = _per_beam(experiment, gates) * beams + PER_SAMPLE * min(samples, at_once)
    return PROGRAM + PER_STATE * in_states + images + rings


def _of_rings(experiment: Experiment) -> float:
    """Bytes of the images of rings while they are fitted."""
    doppler = experiment.doppler
    if doppler is None:
        return 0.0
    pixels = doppler.camera.width * doppler.camera.height
    return pixels * (PER_PIXEL + PER_SPEED * (len(doppler.v_los) - 1))


def _per_beam(experiment: Experiment, gates: int) -> float:
    """Bytes that grow with the number of beams: the wake's nodes, images, vectors."""
    orders = experiment.render.max_order
    # Stokes vector, errors, correlation; both products with their errors; the detector's
    quantities = 11 + (orders if orders > 1 else 0) + 2 * bool(experiment.detector)
    voxels = gates if experiment.volume else 0
    return (
        PER_NODE
        + image_bytes(1, gates, quantities)
        + PER_VOXEL * voxels
        + PER_VECTOR * _vectors_per_beam(experiment)
    )


def _vectors_per_beam(experiment: Experiment) -> float:
    """Vectors of all methods and sources over the number of beams."""
    if experiment.volume:
        gates, volume = experiment.scan.gate_count, experiment.volume
        return gates / volume.stride**3 * len(volume.methods)
    sources = 5 if experiment.detector else 4
    return len(experiment.retrieval.methods) * sources / experiment.retrieval.stride**2


def check_size(experiment: Experiment, columns: int, rows: int) -> None:
    """Refuse images that would take more memory than a run may, or more layers than files hold.

    Parameters
    ----------
    experiment : Experiment
    columns, rows : int
        Of beams in an image.

    Raises
    ------
    InputError
        With what it would take.
    """
    gates, each = experiment.scan.gate_count, _layers_per_gate(experiment)
    most = (MOST_LAYERS - 3) // each  # three are not of a gate: Y, with noise, and its error
    if gates > most:
        raise InputError(
            f"scan.gate_count: {gates} is not allowed with {each} layers each; expected at most "
            f"{most}, as an EXR file has at most {MOST_LAYERS} layers"
        )
    check_memory(
        forecast(experiment, columns * rows),
        experiment.render.memory,
        f"scan: {columns} x {rows} beams x {gates} gates",
        "a larger wake.spacing, retrieval.stride or fewer gates",
    )


def check_states(experiment: Experiment, beams: int, in_states: int) -> None:
    """Refuse air in more states than a run may have in memory; parameters as of `forecast`.

    Raises
    ------
    InputError
        With what it would take.
    """
    check_memory(
        forecast(experiment, beams, in_states),
        experiment.render.memory,
        f"scan.air: moving, of {in_states:.2g} values in all states of a scan,",
        "frozen air, a shorter scan or a larger wake.spacing",
    )


def _layers_per_gate(experiment: Experiment) -> int:
    """Layers of an image for each of its gates."""
    render = experiment.render
    polarised = "polarized" in render.variant
    depolarisation = polarised and tuple(experiment.lidar.stokes) == (1, 1, 0, 0)
    orders = render.max_order + 2 if render.max_order > 1 else 0
    noisy = 2 * bool(experiment.detector)
    return 5 + 2 * polarised + 2 * depolarisation + orders + noisy


def most_nodes(experiment: Experiment) -> int:
    """Nodes of the wake that a run can have in memory; every one has a beam with ``aim: grid``."""
    beams = experiment.scan.aim == "grid" and experiment.wake.depth == "plane"
    # the memory of the gates is checked by `check_size`
    each = _per_beam(experiment, 1) if beams else PER_NODE
    left = ceiling(experiment.render.memory) - PROGRAM
    return max(1, min(MOST_NODES, int(left / each)))


def check_brightness(
    experiment: Experiment, extinction: Sequence[xr.DataArray], plan: ScanPlan, albedo: float
) -> None:
    """Refuse images whose pixels would mostly be dark, by the lidar equation of the median pixel.

    Raises
    ------
    InputError
        Too few samples contribute: free flights that end elsewhere, or a field of view that
        contains hardly any of the beam; or light too weak for its error in single precision.
    """
    lidar, render, mapping = experiment.lidar, experiment.render, experiment.wake.extinction
    inside = float(np.median([np.median(field.values) for field in extinction]))
    if not inside > 0:
        raise InputError(
            "wake.extinction.background: 0 is not allowed with a wake that fills less than half "
            "of the image; expected more, so that pixels have light and errors"
        )
    length, distance = float(np.median(plan.gate_length())), float(np.median(plan.ranges()[0]))
    around = mapping.background + mapping.molecules
    arriving = math.exp(-min(around * plan.gate_start, 300))
    light = lidar.aperture_area / distance**2 * albedo * inside * length / (4 * math.pi)
    if light * arriving**2 < SINGLE:
        raise InputError(
            f"wake.extinction: {around:g} 1/m on the way to {inside:g} 1/m of albedo {albedo:g} at "
            f"{distance:g} m is not allowed; expected that at least {SINGLE:g} of the light comes "
            f"back, not {light * arriving**2:.1g}"
        )
    beams = len(plan.y) * len(plan.z)
    samples = most_samples(experiment, beams)
    least = least_samples(experiment, extinction, plan)
    if samples < least:
        key, value = "lidar.fov_half", shown(lidar.fov_half, "mrad")
        if render.estimator == "analog":
            key, value = "render.estimator", "analog"
        chosen = render.samples_per_beam == "auto" and experiment.detector
        asked, needed = ("max_samples", least * beams) if chosen else ("samples_per_beam", least)
        raise InputError(
            f"{key}: {value} is not allowed with {samples} samples per beam, of "
            f"which {CONTRIBUTIONS * samples / least:.2g} would bring light to a pixel; expected "
            f"render.{asked} of {needed:.3g} or more"
        )


def most_samples(experiment: Experiment, beams: int) -> int:
    """Samples per beam that an image may have, where their number is chosen; else their number."""
    render, gates = experiment.render, experiment.scan.gate_count
    if experiment.detector is None:
        return render.without_detector(gates)
    return render.most_samples(beams, gates)


def least_samples(
    experiment: Experiment, extinction: Sequence[xr.DataArray], plan: ScanPlan
) -> int:
    """Samples per beam of which `CONTRIBUTIONS` bring light to a pixel of the median extinction.

    2 where nearly all do.
    """
    lidar, mapping = experiment.lidar, experiment.wake.extinction
    distance = float(np.median(plan.ranges()[0]))
    seen = overlap(lidar, distance)
    if experiment.render.estimator == "analog":
        # samples contribute if they collide in the gate
        inside = float(np.median([np.median(field.values) for field in extinction]))
        around = mapping.background + mapping.molecules
        arriving = math.exp(-min(around * plan.gate_start, 300))
        fraction = seen * inside * float(np.median(plan.gate_length())) * arriving
    else:
        fraction = seen / plan.gate_count
        if seen >= 0.9:
            return 2
    # their number is counted in 31 bits
    return math.ceil(min(CONTRIBUTIONS / max(fraction, 1e-300), 2.0**31))


def overlap(lidar: BackscatterLidar, distance: float) -> float:
    """Fraction of the light from a distance (m) that arrives within the field of view.

    Mean over the beam's Gaussian cross-section and the telescope's disc, which are concentric: a
    point at r from the axis is in view of points of the disc within ``fov_half`` times the
    distance.
    """
    seen = math.tan(lidar.fov_half) * distance
    sigma = float(lidar.radius_at(distance)) / 2
    # of a Gaussian in the plane, the fraction beyond r is exp(-r^2 / 2 sigma^2): its quantiles
    share = (np.arange(1000) + 0.5) / 1000
    gap = sigma * np.sqrt(-2 * np.log(share))
    area = math.pi * lidar.aperture_radius**2
    return float(_lens(gap, seen, lidar.aperture_radius).mean() / area)


def _lens(gap: np.ndarray, first: float, second: float) -> np.ndarray:
    """Area that two circles of given radii have in common, their centres being ``gap`` apart."""
    small, large = min(first, second), max(first, second)
    apart = np.clip(gap, large - small + 1e-12 * large, large + small)
    # angles at both centres to where the circles meet
    at_small = (apart**2 + small**2 - large**2) / (2 * apart * small)
    at_large = (apart**2 + large**2 - small**2) / (2 * apart * large)
    at_small, at_large = (np.arccos(np.clip(c, -1, 1)) for c in (at_small, at_large))
    area = small**2 * (at_small - np.sin(2 * at_small) / 2)
    area = area + large**2 * (at_large - np.sin(2 * at_large) / 2)
    area = np.where(gap <= large - small, math.pi * small**2, area)
    return np.where(gap >= large + small, 0.0, area)
