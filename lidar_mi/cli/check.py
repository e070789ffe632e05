"""``lidar-mi check``: whether an experiment can be run, and a summary of it."""

from lidar_mi.cli.options import Changes, ExperimentName
from lidar_mi.cli.terminal import output, print_rows
from lidar_mi.experiment.shipped import experiment_file
from lidar_mi.progress import progress

EXAMPLES = (
    "Examples: `lidar-mi check wake_sensor` - `lidar-mi check my_wake.yaml --set "
    "scan.range='200 m'`"
)


def check(experiment: ExperimentName, set_: Changes = None) -> None:
    """Check whether an experiment can be run; show its instruments and the observed air in numbers.

    Reads the wake, the scattering and the requirements as run does, and writes nothing. A probe of
    about a second tells how long the run will take on this machine.
    """
    from lidar_mi.encounter.check import sections as flight_sections
    from lidar_mi.experiment.preflight.check import sections
    from lidar_mi.experiment.schema import reading as config

    path, changes = experiment_file(experiment), list(set_ or [])
    asked = config.load_variants(path, changes) or {"": config.load(path, changes)}
    with progress() as notice:
        found = [
            section
            for one in asked.values()
            for section in (
                flight_sections(one.read_from(path.parent), notice, timed=True)
                if one.encounter
                else sections(one, path.parent, notice, timed=True, sampled=True)
            )
        ]
    for title, rows in found:
        print_rows(title, rows)
    warned = sum(len(rows) for title, rows in found if ": warnings" in title)
    warnings = f", {warned} warning{'s' * (warned > 1)} above" if warned else ""
    output.print(f"all checks passed{warnings}", highlight=False)
