"""``lidar-mi campaign``: many experiments, on this machine or on many."""

import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table as RichTable

from lidar_mi.cli.options import Device, complete_campaign, examples, quantity
from lidar_mi.cli.terminal import errors, output, print_answer, print_table
from lidar_mi.errors import InputError
from lidar_mi.progress import progress

if TYPE_CHECKING:
    from lidar_mi.campaign.engine import State
    from lidar_mi.campaign.folder import CampaignFolder

EXAMPLES = (
    "lidar-mi campaign run design_map --quick",
    "lidar-mi campaign run my.yaml -o outputs/mine --workers 8",
    "lidar-mi campaign run my.yaml --scheduler tcp://host:8786",
    "lidar-mi campaign status outputs/mine",
)

LINE_EVERY = 10.0
"""Seconds between two lines of progress in a pipe."""

app = typer.Typer(
    help="Run many experiments, on this machine or on many, and map their results.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    epilog=examples(*EXAMPLES),
)

Folder = Annotated[Path, typer.Argument(help="Folder of the campaign.")]


@app.command(epilog=examples(*EXAMPLES))
def run(
    campaign: Annotated[
        str,
        typer.Argument(
            help="Campaign file, name of a shipped one, or experiment with variants.",
            autocompletion=complete_campaign,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder. Default: outputs/NAME.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes on this machine. Default: one per core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="A running dask scheduler: its address or its scheduler file."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of each worker.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="The coarse version in the file.")] = False,
    point: Annotated[
        int | None,
        typer.Option(
            min=0, help="Run one point, 0 to N-1, in this process: for a batch system's job array."
        ),
    ] = None,
    lifetime: Annotated[
        str | None,
        typer.Option(help="Begin no point that would not end within this time, such as '50 min'."),
    ] = None,
    device: Device = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a key of the campaign: --set members=4, --set set.scan.range='200 m'.",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Also with more than 100 000 points.")] = False,
    slurm: Annotated[
        int | None, typer.Option(min=1, help="Workers as jobs of SLURM, so many.")
    ] = None,
    walltime: Annotated[str, typer.Option(help="Of a SLURM job, HH:MM:SS.")] = "01:00:00",
    memory: Annotated[str, typer.Option(help="Of a SLURM job.")] = "4 GB",
    queue: Annotated[str | None, typer.Option(help="Partition of SLURM.")] = None,
    job_script: Annotated[
        bool, typer.Option("--job-script", help="Print SLURM's job and run nothing.")
    ] = False,
) -> None:
    """Run all points of a campaign that are not done, and collect them, and write the report.

    Files are the truth: a campaign that was stopped is completed by the same command. A point that
    fails does not stop the others.
    """
    from lidar_mi.campaign.engine import connected, execute, prepare_campaign
    from lidar_mi.campaign.slurm import slurm_cluster

    seconds = quantity("--lifetime", lifetime, "s", "50 min")
    if slurm and not job_script and shutil.which("sbatch") is None:
        raise InputError("--slurm: there is no sbatch here; expected a login node of SLURM")
    if scheduler and slurm:
        raise InputError("--slurm: not allowed with --scheduler; expected one of the two")
    if job_script:
        with slurm_cluster(memory=memory, walltime=walltime, queue=queue) as cluster:
            output.print(cluster.job_script(), highlight=False, soft_wrap=True)
        return
    changes = list(set_ or []) + ([f"set.device={device}"] if device else [])
    with progress() as notice:
        folder = prepare_campaign(
            campaign, out, quick=quick, confirmed=yes, overrides=changes, notice=notice
        )
    if point is not None:
        _run_point(folder, point)
        return
    client: Any = scheduler
    with ExitStack() as stack:
        stack.enter_context(folder.claimed())
        if slurm:
            jobs = slurm_cluster(memory=memory, walltime=walltime, queue=queue)
            cluster = stack.enter_context(jobs)
            cluster.scale(jobs=slurm)
            client = stack.enter_context(cluster.get_client())
        with progress() as notice:
            connection = stack.enter_context(connected(client, workers, threads, notice))
        with _watched() as watch:
            try:
                state = execute(folder, connection, watch=watch, lifetime=seconds)
            except BaseException as error:
                error.add_note("start it again to do the points that are left")
                raise
    print_answer([_conclude(folder)])
    for table in state.tables():
        print_table(table)
    if state.finished < state.total:
        output.print(f"{state.total - state.finished} points are left: run it again")
    output.print(f"data     {folder.path / 'campaign.nc'}")
    output.print(f"report   {folder.path / 'report.html'}")


@app.command()
def status(folder: Folder) -> None:
    """Count the points of a campaign that are done, failed and running; also while it runs."""
    from lidar_mi.campaign.status import campaign_status

    for table in campaign_status(folder).tables():
        print_table(table)


@app.command()
def collect(folder: Folder) -> None:
    """Collect the points that are done into campaign.nc, and write the report."""
    from lidar_mi.campaign.folder import open_folder

    print_answer([_conclude(open_folder(folder))])
    output.print(f"data     {folder / 'campaign.nc'}")
    output.print(f"report   {folder / 'report.html'}")


@app.command()
def report(
    folder: Folder,
    metric: Annotated[
        list[str] | None,
        typer.Option("--metric", help="A metric to show, as often as needed. Default: chosen."),
    ] = None,
) -> None:
    """Write report.html from campaign.nc, with the metrics that you choose."""
    from lidar_mi.campaign.report import write_report

    with progress() as notice:
        notice("writing the report", None)
        path = write_report(folder, metric)
    output.print(f"report   {path}")


def _conclude(folder: "CampaignFolder") -> str:
    """Collect a campaign and write its report; its first sentences."""
    from lidar_mi.campaign.collect import collect
    from lidar_mi.campaign.report import campaign_answer, write_report

    with progress() as notice:
        collect(folder, notice)
        notice("writing the report", None)
        write_report(folder.path)
    return campaign_answer(folder.path)


def _run_point(folder: "CampaignFolder", number: int) -> None:
    """One point in this process; `collect` gathers all of them later."""
    from lidar_mi.campaign.worker import run_point

    if number >= len(folder.points):
        raise InputError(
            f"--point: {number} is not allowed; expected 0 to {len(folder.points) - 1}"
        )
    outcome = run_point(folder, number)
    output.print(f"{folder.points.title(number)}: {outcome.status}")
    if outcome.status == "failed":
        raise InputError(f"point {number}: {outcome.message}")


@contextmanager
def _watched() -> "Iterator[Callable[[State], None]]":
    """One table that follows the campaign on a terminal, a line now and then in a pipe."""
    if errors.is_terminal:
        with Live(console=errors, transient=True, refresh_per_second=4) as live:
            yield lambda state: live.update(_table(state))
        return
    last = -LINE_EVERY

    def line(state: "State") -> None:
        nonlocal last
        if time.monotonic() - last >= LINE_EVERY or state.finished == state.total:
            last = time.monotonic()
            errors.print(
                f"{state.finished} of {state.total} points, {state.failed} failed, "
                f"{state.rate():.2g} a second, {_clock(state.remaining())} left",
                highlight=False,
                soft_wrap=True,
            )

    yield line


def _table(state: "State") -> RichTable:
    table = RichTable(title=f"campaign {state.name}", title_justify="left", show_header=False)
    rows = [
        ("points", f"{state.finished} of {state.total}, {state.running} running"),
        ("failed", str(state.failed)),
        ("rate", f"{state.rate():.3g} a second on {state.workers} workers"),
        ("time left", _clock(state.remaining())),
        ("images", f"{state.rendered} rendered, {state.reused} re-used"),
        ("slowest step", state.slowest() or "-"),
    ]
    if state.dashboard:
        rows.append(("dashboard", state.dashboard))
    for row in rows:
        table.add_row(*row)
    return table


def _clock(seconds: float) -> str:
    """A duration as h:mm:ss; unknown: a dash."""
    if math.isnan(seconds):
        return "-"
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
