"""Workers of a campaign as jobs of SLURM, by dask-jobqueue."""

from typing import Any

from lidar_mi.errors import InputError


def slurm_cluster(
    *,
    memory: str = "4 GB",
    walltime: str = "01:00:00",
    queue: str | None = None,
    account: str | None = None,
) -> Any:
    """A cluster whose workers are jobs of SLURM, each with one core; `scale` submits them.

    Workers end two minutes before their walltime, and their points go to others.

    memory: of each.
    walltime: of each job, HH:MM:SS.
    queue, account: partition and account.

    Raises InputError: dask-jobqueue is missing; a walltime that is none.

    Returns
    -------
    dask_jobqueue.SLURMCluster
        ``scale(jobs=40)`` submits 40 of them, ``job_script()`` is one as text.
    """
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError:
        raise InputError(
            "--slurm: dask-jobqueue is not installed; expected pip install 'lidar-mi[slurm]'"
        ) from None
    # workers that end themselves lose no point; those that SLURM kills do
    lifetime = _seconds(walltime) - 120
    if lifetime <= 0:
        raise InputError(f"--walltime: {walltime} is not allowed; expected more than 2 minutes")
    return SLURMCluster(
        cores=1,
        processes=1,
        memory=memory,
        walltime=walltime,
        queue=queue,
        account=account,
        worker_extra_args=["--lifetime", f"{lifetime}s", "--lifetime-stagger", "60s"],
        death_timeout=300,
        scheduler_options={"dashboard_address": ":0"},
    )


def _seconds(walltime: str) -> int:
    """HH:MM:SS in seconds."""
    try:
        hours, minutes, seconds = map(int, walltime.split(":"))
    except ValueError:
        raise InputError(
            f"--walltime: {walltime!r} is not allowed; expected HH:MM:SS such as 01:00:00"
        ) from None
    return 3600 * hours + 60 * minutes + seconds
