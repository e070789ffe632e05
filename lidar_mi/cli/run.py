"""``lidar-mi run``: run an experiment."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar_mi.cli.options import Changes, Device, RunName, Variant
from lidar_mi.cli.terminal import output, print_answer, print_table
from lidar_mi.progress import progress
from lidar_mi.schema.shipped import experiment_file

if TYPE_CHECKING:
    from lidar_mi.schema.experiment import Experiment

EXAMPLES = (
    "lidar-mi run wake_backscatter",
    "lidar-mi run my.yaml -o outputs/calm --set wake.texture.rms=0 --set seed=7",
)


_LABELS = {"vortices": "vortices", "line_vortices": "vortices", "coherent_lines": "lines   "}
"""Labels of results other than winds."""


def run(
    experiment: RunName,
    variant: Variant = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Run folder. Default: outputs/NAME.")
    ] = None,
    device: Device = None,
    set_: Changes = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a run of a different experiment.")
    ] = False,
) -> None:
    """Run an experiment.

    Writes images (EXR), winds (NetCDF), metrics (JSON), figures and a report into the run folder.
    A run that was stopped is resumed with the images it has.
    """
    from lidar_mi.schema import reading

    path, changes = experiment_file(experiment), list(set_ or [])
    if device:
        changes.append(f"device={device}")
    variants = reading.load_variants(path, changes)
    loaded = next(iter(variants.values())) if variants else reading.load(path, changes)
    if variant:
        sections = {"render": loaded.imaged_wake, "doppler.render": loaded.fringes}
        changes += [f"{key}.variant={variant}" for key, section in sections.items() if section]
    if variants:
        _run_study(reading.load_variants(path, changes), out, path, overwrite)
        return
    loaded = reading.load(path, changes)
    folder = out or Path("outputs") / loaded.name
    with progress() as notice:
        notice(f"starting {loaded.name}", None)
        from lidar_mi.assessment.report.summary import summary
        from lidar_mi.experiment.folder.run_folder import RESULTS
        from lidar_mi.experiment.run import run as start

        done = start(loaded, folder, beside=path.parent, overwrite=overwrite, notice=notice)
    print_answer(done.answer)
    for table in summary(done.metrics, _averaged(loaded)):
        print_table(table)
    output.print(f"report   {folder / 'report.html'}")
    output.print(f"figures  {folder / 'figures'}")
    for result, file in RESULTS.items():
        if done.results.get(result) is not None:
            label = _LABELS.get(result, "winds   ")
            output.print(f"{label} {folder / file}")


def _run_study(
    variants: Mapping[str, "Experiment"], out: Path | None, path: Path, overwrite: bool
) -> None:
    """Variants of one experiment, each in its own folder, and their comparison."""
    first, experiment = next(iter(variants.items()))
    name = experiment.name.removesuffix(f".{first}")
    folder = out or Path("outputs") / name
    with progress() as notice:
        notice(f"starting {name}", None)
        from lidar_mi.assessment.report.summary import summary
        from lidar_mi.experiment.folder.records import read_answer
        from lidar_mi.experiment.study import run as start

        metrics = start(name, variants, folder, path.parent, overwrite, notice)
    for variant in metrics:
        output.print(f"\n{variant}", style="bold")
        print_answer(read_answer(folder / variant))
    for variant, numbers in metrics.items():
        output.print(f"\n{variant}", style="bold")
        for table in summary(numbers, _averaged(variants[variant])):
            print_table(table)
    output.print(f"report   {folder / 'report.html'}")


def _averaged(experiment: "Experiment") -> tuple[int, ...]:
    """Numbers of images of rings that an experiment averages."""
    return experiment.fringes.retrieval.averaged if experiment.fringes else ()
