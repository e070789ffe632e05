"""``lidar-mi fly``: an aircraft flies into the wake of an experiment."""

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from lidar_mi.cli.options import Changes, Device, OptionalFlightName
from lidar_mi.cli.terminal import output, print_answer, print_table
from lidar_mi.errors import InputError
from lidar_mi.progress import progress
from lidar_mi.schema.shipped import experiment_file

EXAMPLES = (
    "lidar-mi fly encounter",
    "lidar-mi fly encounter --mode perfect",
    "lidar-mi fly --replay outputs/encounter --set encounter.aircraft.aileron_rate='20 deg/s'",
    "lidar-mi fly my.yaml -o outputs/mine --set encounter.path.crossing_angle='30 deg'",
)


class Mode(StrEnum):
    """Values of ``encounter.control.mode``."""

    OFF = "off"
    FEEDFORWARD = "feedforward"
    PERFECT = "perfect"


def fly(
    experiment: OptionalFlightName = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder of the results. Default: outputs/NAME, with --replay outputs/NAME_replay.",
        ),
    ] = None,
    mode: Annotated[
        Mode | None,
        typer.Option(
            help="Flight of interest (encounter.control.mode): off, a pilot levels the wings; "
            "feedforward, with the lidar; perfect, with the true wind as preview. Those with less "
            "information are flown as well, with feedforward also perfect."
        ),
    ] = None,
    device: Device = None,
    set_: Changes = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            metavar="FLIGHT",
            help="Folder of a finished flight with the lidar. Its estimates are used again, with "
            "another aircraft (encounter.aircraft) or control (encounter.control). Nothing is "
            "rendered.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a flight of a different experiment.")
    ] = False,
    processes: Annotated[
        int,
        typer.Option(
            min=1,
            max=2,
            help="Processes that estimate; with 2 wind and vortices are estimated at the same "
            "time. Default: 2 if there are two cores.",
            show_default=False,
        ),
    ] = min(2, os.cpu_count() or 1),
) -> None:
    """Fly into the wake of an experiment, with the lidar in the loop.

    The same wake is met without control, with the autopilot, with the lidar and with perfect
    preview. Writes time series and the track of the vortices (NetCDF), metrics (JSON), figures, a
    video and a report.
    """
    from lidar_mi.experiment.folder.records import RECORD
    from lidar_mi.schema import reading

    changes = list(set_ or [])
    if device:
        changes.append(f"device={device}")
    if mode:
        changes.append(f"encounter.control.mode={mode.value!r}")
    if experiment is not None:
        path = experiment_file(experiment)
    elif replay is not None:
        path = replay / RECORD
    else:
        raise InputError("EXPERIMENT: missing; expected an experiment, or --replay FLIGHT")
    variants = reading.load_variants(path, changes)
    if variants:
        raise InputError(f"{path}: variants: not allowed for a flight; expected one experiment")
    loaded = reading.load(path, changes).read_from(path.parent)
    if loaded.encounter is None:
        raise InputError(
            f"encounter: missing in {loaded.name}; expected the section of a flight, or lidar-mi "
            "run for an experiment without one"
        )
    folder = out or Path("outputs") / (loaded.name + ("_replay" if replay else ""))
    with progress() as notice:
        notice(f"starting {loaded.name}", None)
        from lidar_mi.encounter.fly import fly as start

        done = start(
            loaded, folder, replay=replay, overwrite=overwrite, processes=processes, notice=notice
        )
    print_answer(done.answer)
    for table in done.tables()[1:]:
        print_table(table)
    output.print(f"report   {folder / 'report.html'}")
    output.print(f"figures  {folder / 'figures'}")
    output.print(f"flights  {folder / 'flight.nc'}")
