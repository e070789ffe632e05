"""Memory of a run, before it begins: what images, winds and states of the air take."""

from lidar_mi.atmosphere.wake import MOST_NODES
from lidar_mi.errors import InputError
from lidar_mi.experiment.schema.experiment import Experiment
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

PER_NODE = 160
"""Bytes of a node of the wake: twenty fields in double precision."""
PER_VECTOR = 400
"""Bytes of a vector, per method and source: 25 variables, twice where they are concatenated."""
PER_VOXEL = 200
"""Bytes of a voxel of a volume whose wind is retrieved."""


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


def most_samples(experiment: Experiment, beams: int) -> int:
    """Samples per beam that an image may have, where their number is chosen; else their number."""
    render, gates = experiment.render, experiment.scan.gate_count
    if experiment.detector is None:
        return render.without_detector(gates)
    return render.most_samples(beams, gates)
