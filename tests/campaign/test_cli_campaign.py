"""``lidar-mi campaign``: what it prints, and what it answers to wrong input.

Detects: a command that ends in a traceback, a job of a batch system whose workers outlive it, a
point of a job array that `collect` does not see, a shipped campaign that is none.
"""

import sys

import pytest

from lidar_mi.campaign.engine import prepare_campaign
from lidar_mi.campaign.slurm import slurm_cluster
from lidar_mi.cli.app import main
from lidar_mi.errors import InputError
from lidar_mi.schema.shipped import campaigns
from tests.support.campaigns import described


@pytest.fixture
def command(monkeypatch):
    """A command in this process; returns its exit code."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["lidar-mi", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code or 0

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["design_map", "which_knob", "luck", "scan_patterns", "airport_design"]
)
def test_shipped_campaigns_can_be_run(tmp_path, name):
    assert name in campaigns()
    # every point is checked; of the coarse version, too
    whole = prepare_campaign(name, tmp_path / "whole")
    coarse = prepare_campaign(name, tmp_path / "coarse", quick=True)
    assert len(coarse.points) < len(whole.points) / 3


@pytest.mark.slow
def test_points_of_a_job_array_are_collected(tmp_path, command, capsys):
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]})
    out = tmp_path / "out"
    assert command("campaign", "run", path, "-o", out, "--point", 1) == 0
    assert "retrieval.template 8: done" in capsys.readouterr().out
    for counted in (("campaign", "status"), ("info",)):
        assert command(*counted, out) == 0
        assert "│ done                   │ 1" in capsys.readouterr().out
    assert command("campaign", "collect", out) == 0
    assert ": 1 of 2 runs done, 0 failed, 1 missing." in capsys.readouterr().out
    assert command("campaign", "run", path, "-o", out, "--point", 2) == 2
    assert "--point: 2 is not allowed; expected 0 to 1" in capsys.readouterr().err


def test_a_job_of_slurm_ends_its_worker_in_time():
    with slurm_cluster(memory="3 GB", walltime="00:30:00", queue="short") as cluster:
        job = cluster.job_script()
    assert "#SBATCH -p short" in job and "#SBATCH -t 00:30:00" in job
    assert "--lifetime 1680s" in job and "--nthreads 1" in job
    for walltime in ("30", "00:01:00"):
        with pytest.raises(InputError, match="--walltime"):
            slurm_cluster(walltime=walltime)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "dezign_map"], "did you mean design_map? Expected a campaign file or one of"),
        (["run", "wake_sensor"], "one experiment, not a campaign; expected lidar-mi run"),
        (["run", "luck", "--slurm", "2", "--scheduler", "x"], "--slurm"),
        (["run", "luck", "--lifetime", "3 m"], "--lifetime: '3 m' is not allowed"),
        (["status", "."], "no campaign.yaml in it; expected the folder of a campaign"),
    ],
)
def test_wrong_input_gets_one_line(tmp_path, command, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert command("campaign", *arguments) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and not list(tmp_path.iterdir())
