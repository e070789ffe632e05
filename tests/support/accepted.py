"""What ``check`` accepts runs."""

from pathlib import Path

from hypothesis import strategies as st

from lidar_mi.errors import InputError
from lidar_mi.experiment.memory import most_samples
from lidar_mi.experiment.preflight import check
from lidar_mi.schema import reading
from tests.support.cases import Case
from tests.support.hostile_experiments import as_yaml, settings

MOST_PATHS = 2e6
"""Light paths of an experiment that is run: more takes its time, and nothing else."""


def runs(path: str) -> None:
    """Run an experiment if it is accepted, in memory and without figures.

    Raises
    ------
    AssertionError
        It is refused after it was accepted.
    """
    from lidar_mi.experiment.run import run
    from tests.support.experiments import without_figures

    try:
        experiment = reading.load(path)
        list(check.sections(experiment, Path()))
    except InputError:
        return
    if _paths(experiment) > MOST_PATHS:
        return
    with without_figures():
        try:
            run(experiment, notice=lambda text, fraction: None)
        except InputError as error:
            raise AssertionError(f"check accepts, run refuses: {error}") from None


def _paths(experiment) -> float:
    """Light paths of all images, as far as the file says."""
    wake, rings = experiment.wake, experiment.doppler
    total = 0.0
    if wake:
        pair = wake.vortex_pair or wake.turbine
        beams = experiment.scan.columns * experiment.scan.rows
        if experiment.scan.aim == "grid" and pair:
            beams = pair.width * pair.height / wake.spacing**2
        samples = most_samples(
            experiment.render, experiment.detector, max(1, int(beams)), experiment.scan.gate_count
        )
        orders = experiment.render.max_order
        total += 2 * beams * samples * orders * experiment.scan.gate_count
    if rings:
        camera, reading_of = rings.camera, rings.retrieval
        images = len(rings.v_los) * (1 + max(reading_of.averaged) * reading_of.images)
        total += camera.width * camera.height * (rings.render.samples_per_pixel + images)
    return total


def run_cases() -> st.SearchStrategy:
    """Small experiments, most of them right."""
    return settings().map(
        lambda data: Case("run", ("python", "runs('a.yaml')"), {"a.yaml": as_yaml(data)})
    )
