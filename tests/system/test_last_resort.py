"""What ends a command without being bad input: disks, memory, equations, signals.

Detects a traceback where a line is due, a wrong exit code, a traceback that is nowhere, and a word
about resuming from a command that cannot resume.
"""

import errno
import signal

import numpy as np
import pytest
import torch

from lidar_mi.cli.exit_codes import exit_by
from lidar_mi.errors import Stopped
from tests.support.experiments import replace_stages


def said_by(error, capsys):
    """Exit code and lines on stderr of a command that ends in an error."""

    def command(**_):
        raise error

    with pytest.raises(SystemExit) as stop:
        exit_by(command)
    return stop.value.code, capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a.nc"), "a.nc: No space left on device"),
        (OSError("unable to\nread"), "unable to read"),
        (
            MemoryError("Unable to allocate 15 GiB"),
            "not enough memory (Unable to allocate 15 GiB); expected fewer beams, gates or "
            "samples, or a larger machine",
        ),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: 2 GB"),
            "not enough memory (DefaultCPUAllocator: can't allocate memory: 2 GB); expected fewer "
            "beams, gates or samples, or a larger machine",
        ),
        (
            np.linalg.LinAlgError("Singular matrix"),
            "equations without a solution (Singular matrix); expected data that determine it",
        ),
        (
            torch.linalg.LinAlgError("not positive-definite"),
            "equations without a solution (not positive-definite); expected data that determine it",
        ),
    ],
)
def test_one_line_and_exit_code_2(error, line, capsys):
    assert said_by(error, capsys) == (2, [f"lidar-mi: {line}"])


def test_errors_of_the_program_keep_their_traceback(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        exit_by(lambda **_: 1 / 0)
    monkeypatch.setenv("LIDAR_MI_TRACEBACK", "1")

    def command(**_):
        raise MemoryError

    with pytest.raises(MemoryError):
        exit_by(command)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_outside_a_run_do_not_speak_of_resuming(number, capsys):
    # a shell starts what is in the background with some of them ignored
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stop:
            exit_by(lambda **_: signal.raise_signal(number))
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert stop.value.code == 128 + number
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("lidar-mi: stopped") and "start it again" not in line


def test_an_ignored_hangup_stays_ignored():
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with pytest.raises(SystemExit) as stop:
            exit_by(lambda **_: signal.raise_signal(signal.SIGHUP))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert stop.value.code == 0


def test_a_signal_under_another_exception_is_a_signal(capsys):
    """As libraries raise theirs from it."""
    error = RuntimeError("kernel failed")
    error.__cause__ = Stopped(signal.SIGTERM)
    assert said_by(error, capsys) == (143, ["lidar-mi: stopped by SIGTERM"])


def test_the_traceback_is_in_the_log(there, lidar_mi, quick, monkeypatch):
    def broken(*_, log):
        raise np.linalg.LinAlgError("Singular matrix")

    replace_stages(monkeypatch, wind=broken)
    code, _, err = lidar_mi("run", "tiny.yaml", "-o", "run")
    assert code == 2 and "Traceback" not in err
    assert "traceback in run/log.txt" in err.splitlines()[-1]
    log = (there / "run" / "log.txt").read_text()
    assert "in broken" in log and log.splitlines()[-1].endswith("failed: Singular matrix")
    assert "failed: Singular matrix" in lidar_mi("info", "run")[1]
