"""``lidar-mi check``: whether an experiment can be run, and a summary of it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from lidar_mi.cli.options import Changes, ExperimentName
from lidar_mi.cli.terminal import output, print_rows
from lidar_mi.progress import Notice, progress
from lidar_mi.schema.shipped import experiment_file

if TYPE_CHECKING:
    from lidar_mi.experiment.describe import Section
    from lidar_mi.schema.experiment import Experiment

EXAMPLES = (
    "lidar-mi check wake_sensor",
    "lidar-mi check wake_sensor --forecast",
    "lidar-mi check my_wake.yaml --set scan.range='200 m'",
)


def check(
    experiment: ExperimentName,
    set_: Changes = None,
    forecast: Annotated[
        bool,
        typer.Option(
            "--forecast",
            help="Also the time of a run on this machine and the number of Monte Carlo samples, by "
            "rendering a few samples and timing a retrieval: several seconds.",
        ),
    ] = False,
) -> None:
    """Check whether an experiment can be run; show its instruments and the observed air in numbers.

    Reads the wake, the scattering and the requirements as run does, and writes nothing.
    """
    from lidar_mi.schema import reading

    path, changes = experiment_file(experiment), list(set_ or [])
    experiments = reading.load_variants(path, changes) or {"": reading.load(path, changes)}
    with progress() as notice:
        tables = [
            section
            for checked in experiments.values()
            for section in _sections(checked.read_from(path.parent), notice, forecast)
        ]
    for title, rows in tables:
        print_rows(title, rows)
    warned = sum(len(rows) for title, rows in tables if ": warnings" in title)
    verdict = "all checks passed"
    if warned:
        verdict = f"it can be run; {warned} warning{'s' * (warned > 1)} above"
    output.print(verdict, highlight=False)


def _sections(experiment: "Experiment", notice: Notice, forecast: bool) -> Iterator["Section"]:
    """Tables of a run or of a flight."""
    notice(f"checking {experiment.name}", None)
    if experiment.encounter:
        from lidar_mi.encounter.check import sections as flight_sections

        return flight_sections(experiment, notice, timed=forecast)
    from lidar_mi.experiment.preflight.check import sections

    return sections(experiment, experiment.folder, notice, timed=forecast, sampled=forecast)
