"""The command line's help. Detects a command without help, help without an example, an example that
cannot be typed, and a command that is not installed."""

import re
from importlib.metadata import entry_points, version

import pytest

from lidar_mi.cli import app as cli
from lidar_mi.system.doctor import Check, Checkup
from tests.support.command_line import TINY, shell, words_of

COMMANDS = (
    *("list", "new", "explain", "run", "fly", "check", "render", "retrieve", "export", "info"),
    *("aerosol", "rings", "calibrate", "v_los", "campaign", "doctor"),
)


def test_the_command_is_installed():
    (script,) = [s for s in entry_points(group="console_scripts") if s.name == "lidar-mi"]
    assert script.load() is cli.main


def test_version_in_a_fresh_process():
    done = shell("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == f"lidar-mi {version('lidar-mi')}"


def test_help_names_every_command(lidar_mi):
    code, out, _ = lidar_mi("--help")
    assert code == 0
    for command in COMMANDS:
        assert re.search(rf"^│ {command} ", out, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_example(lidar_mi, command):
    code, out, _ = lidar_mi(command, "--help")
    assert code == 0
    assert re.search(rf"Examples?: .*lidar-mi {command}", words_of(out))


def test_examples_of_the_help_can_be_typed(there, lidar_mi, quick):
    """Those of run and render, with the files they name; an option that is gone would fail."""
    (there / "my.yaml").write_text(TINY)
    code, *_ = lidar_mi(
        "run", "my.yaml", "-o", "outputs/calm", "--set", "wake.texture.rms=0", "--set", "seed=7"
    )
    assert code == 0
    _, out, _ = lidar_mi("run", "--help")
    assert "run my.yaml -o outputs/calm --set wake.texture.rms=0 --set seed=7" in words_of(out)
    _, out, _ = lidar_mi("render", "--help")
    typed = re.search(r"Example: • lidar-mi (render .*?\.exr)", words_of(out))[1]
    assert lidar_mi(*typed.split())[0] == 0
    assert (there / "slab.exr").is_file()


def test_a_missing_argument_is_a_usage_error(lidar_mi):
    code, _, err = lidar_mi("rings")
    assert code == 2 and "missing argument" in err.lower() and "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("run",), "missing argument"),
        (("run", "a.yaml", "--nope"), "no such option: --nope"),
        (("nope",), "no such command 'nope'"),
        (("render", "a.xml", "-s", "many"), "invalid value for '-s'"),
        (("retrieve", "a.exr", "b.exr", "--dt", "x\x1b[31m"), "invalid value for '--dt'"),
        (("check", "a.yaml", "b" * 3000), "unexpected extra argument"),
    ],
)
def test_wrong_usage_is_one_line(lidar_mi, arguments, says):
    """Where typer alone draws a box of five."""
    code, out, err = lidar_mi(*arguments)
    (line,) = err.splitlines()
    assert code == 2 and out == "" and says in line.lower()
    assert line.startswith("lidar-mi: ") and line.isprintable() and len(line) <= 300
    assert line.endswith(" --help")


@pytest.mark.parametrize(
    ("ok", "code", "end"), [(True, 0, "all checks passed"), (False, 1, "1 of 2")]
)
def test_doctor_ends_as_its_findings_say(lidar_mi, monkeypatch, ok, code, end):
    found = Checkup(
        (Check("LLVM library", ok, "what it is", "what to do"), Check("torch", True, "2"))
    )
    monkeypatch.setattr("lidar_mi.system.doctor.doctor", lambda: found)
    ended, out, _ = lidar_mi("doctor")
    assert ended == code and end in out.splitlines()[-1]
    assert ("FAILED" in out) != ok and ("to repair" in out) != ok
