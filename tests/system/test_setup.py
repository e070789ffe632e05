"""Set-up of a fresh machine. Detects a second installation where nothing changed, a broken .venv
kept, an LLVM not installed although it could be, and failures that do not say what to type.

The script runs for real in a copy of the project's folder; a stand-in for python3 answers for the
parts that would change the machine (making .venv, pip, the search for LLVM), stand-ins for apt-get,
sudo and id for those that would need a network or another user.
"""

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from lidar_mi.cli.doctor import doctor as show_checks
from lidar_mi.system import doctor, llvm

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or not (ROOT / "scripts" / "setup.sh").is_file(),
    reason="set-up is a shell script of the source tree",
)

# "good_llvm" is a file: there as long as the pretended machine has a suitable LLVM.
PYTHON = """#!/bin/sh
case "$*" in
    *lidar_mi/system/llvm.py*)
        if [ -e "$STATE/good_llvm" ]; then echo /usr/lib/libLLVM.so.19.1; exit 0; fi
        echo "libLLVM: found none; sudo apt install libllvm19"; exit 3 ;;
    "-m venv "*)
        echo venv >>"$STATE/log"
        mkdir -p .venv/bin; cp "$0" .venv/bin/python
        [ ! -e "$STATE/no_venv" ] ;;
    "-m pip install "*)
        echo "pip${PIP_EXTRA_INDEX_URL:+ $PIP_EXTRA_INDEX_URL}" >>"$STATE/log"
        if [ -e "$STATE/killed" ]; then kill -KILL $PPID; fi
        [ ! -e "$STATE/no_network" ] ;;
    *download.pytorch.org*) [ -e "$STATE/cpu_index" ] ;;
    "-c import lidar_mi") ;;
    *) exec "$REAL_PYTHON" "$@" ;;
esac
"""

APT = """#!/bin/sh
echo "$(basename "$0") $*" >>"$STATE/log"
case "$*" in
    "show libllvm19") [ ! -e "$STATE/only_llvm18" ] ;;
    "show libllvm18") ;;
    show*) exit 1 ;;
    install*) [ ! -e "$STATE/no_network" ] && : >"$STATE/good_llvm" ;;
    update*) [ ! -e "$STATE/no_network" ] ;;
esac
"""


class Machine:
    """A pretended machine: a project folder, stand-in programs on PATH, and facts as files."""

    def __init__(self, root: Path):
        self.project = root / "a project"
        self.state = root / "state"
        self.programs = root / "bin"
        for folder in (self.project / "scripts", self.state, self.programs):
            folder.mkdir(parents=True)
        shutil.copy(ROOT / "scripts" / "setup.sh", self.project / "scripts")
        shutil.copy(ROOT / "pyproject.toml", self.project)
        for tool in ["basename", "cat", "cp", "dirname", "env", "mkdir", "rm", "sh"]:
            (self.programs / tool).symlink_to(shutil.which(tool))
        self.program("python3", PYTHON)
        self.is_user(0)
        self.fact("good_llvm")

    def program(self, name: str, text: str) -> None:
        path = self.programs / name
        path.write_text(text)
        path.chmod(path.stat().st_mode | stat.S_IXUSR)

    def is_user(self, number: int) -> None:
        self.program("id", f"#!/bin/sh\necho {number}\n")

    def has_apt(self) -> None:
        self.program("apt-get", APT)
        self.program("apt-cache", APT)

    def fact(self, name: str, there: bool = True) -> None:
        path = self.state / name
        path.touch() if there else path.unlink()

    def set_up(self, **environ: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            [self.project / "scripts" / "setup.sh"],
            check=False,
            capture_output=True,
            text=True,
            timeout=60,
            cwd=self.state,
            env={
                "PATH": str(self.programs),
                "STATE": str(self.state),
                "REAL_PYTHON": sys.executable,
            }
            | environ,
        )

    def log(self) -> list[str]:
        """What the stand-ins were asked for since the last call."""
        path = self.state / "log"
        lines = path.read_text().splitlines() if path.exists() else []
        path.unlink(missing_ok=True)
        return lines


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path)


def test_scripts_parse():
    for shell, script in (("sh", "scripts/setup.sh"), ("bash", ".ci/run")):
        if shutil.which(shell):
            subprocess.run([shell, "-n", ROOT / script], check=True, timeout=30)
        assert os.access(ROOT / script, os.X_OK), f"{script} is not executable"


@pytest.mark.parametrize("name", ["a:b", 'a "b"', "a $HOME", "a\nb", "a\\b", "a `b`"])
def test_folders_that_cannot_hold_a_virtual_environment(machine, name):
    machine.project = machine.project.rename(machine.project.with_name(name))
    done = machine.set_up()
    assert done.returncode == 1 and "move the project to another folder" in done.stderr
    assert machine.log() == [] and not (machine.project / ".venv").exists()


def test_second_run_does_nothing_until_pyproject_changes(machine):
    first = machine.set_up()
    assert first.returncode == 0, first.stderr
    assert machine.log() == ["venv", "pip"]
    second = machine.set_up()
    assert (second.returncode, second.stdout, second.stderr) == (0, "", "")
    assert machine.log() == []
    with (machine.project / "pyproject.toml").open("a") as file:
        file.write("# changed\n")
    assert machine.set_up().returncode == 0
    assert machine.log() == ["pip"]


def test_a_moved_folder_is_installed_again(machine):
    machine.set_up()
    machine.log()
    machine.project = machine.project.rename(machine.project.with_name("moved"))
    assert machine.set_up().returncode == 0
    assert machine.log() == ["pip"]


def test_an_interrupted_installation_is_made_anew(machine):
    machine.fact("killed")
    assert machine.set_up().returncode != 0
    assert machine.log() == ["venv", "pip"]
    machine.fact("killed", there=False)
    done = machine.set_up()
    assert done.returncode == 0, done.stderr
    assert "making it anew" in done.stdout
    assert machine.log() == ["venv", "pip"]
    assert not (machine.project / ".venv" / ".installing").exists()


@pytest.mark.parametrize("damage", ["empty", "no interpreter", "dangling link"])
def test_a_broken_environment_is_made_anew(machine, damage):
    venv = machine.project / ".venv"
    if damage == "dangling link":
        venv.symlink_to("nowhere")
    else:
        machine.set_up()
        shutil.rmtree(venv) if damage == "empty" else (venv / "bin" / "python").unlink()
        venv.mkdir(exist_ok=True)
    machine.log()
    done = machine.set_up()
    assert done.returncode == 0, done.stderr
    assert machine.log() == ["venv", "pip"]


def test_without_network_it_reports_this_and_can_be_repeated(machine):
    machine.fact("no_network")
    done = machine.set_up()
    assert done.returncode == 1
    assert "run make setup again" in done.stderr
    machine.fact("no_network", there=False)
    machine.log()
    assert machine.set_up().returncode == 0
    assert machine.log() == ["pip"]


CPU_INDEX = "https://download.pytorch.org/whl/cpu"


@pytest.mark.parametrize(
    ("gpu", "answers", "given", "asked"),
    [
        (False, True, {}, f"pip {CPU_INDEX}"),
        (False, True, {"PIP_EXTRA_INDEX_URL": "https://mine"}, f"pip https://mine {CPU_INDEX}"),
        (False, True, {"PIP_EXTRA_INDEX_URL": CPU_INDEX}, f"pip {CPU_INDEX}"),
        (False, False, {}, "pip"),
        (True, True, {}, "pip"),
    ],
)
def test_torch_for_the_processor_where_there_is_no_gpu(machine, gpu, answers, given, asked):
    """It says what it did, unless there is nothing to choose."""
    machine.program("nvidia-smi", f"#!/bin/sh\nexit {int(not gpu)}\n")
    if answers:
        machine.fact("cpu_index")
    done = machine.set_up(**given)
    assert done.returncode == 0, done.stderr
    assert machine.log() == ["venv", asked]
    assert ("no NVIDIA GPU here" in done.stdout) == (
        asked.endswith(CPU_INDEX) and given != {"PIP_EXTRA_INDEX_URL": CPU_INDEX}
    )
    assert ("did not answer within 3 seconds" in done.stdout) == (not gpu and not answers)


def test_without_the_venv_module_it_prints_what_to_install(machine):
    machine.fact("no_venv")
    done = machine.set_up()
    assert done.returncode == 1
    assert "apt install python3-venv" in done.stderr
    assert not (machine.project / ".venv").exists()


def test_too_old_or_absent_python_is_refused(machine):
    done = machine.set_up(PYTHON="/bin/false")
    assert done.returncode == 1
    assert "PYTHON=/bin/false" in done.stderr
    machine.program("python3", "#!/bin/sh\nexit 1\n")
    done = machine.set_up()
    assert done.returncode == 1
    assert "no Python 3.11 or newer" in done.stderr
    machine.program("python3.12", PYTHON)
    assert machine.set_up().returncode == 0


@pytest.mark.parametrize("user", ["root", "sudo"])
def test_llvm_is_installed_where_that_is_allowed(machine, user):
    machine.fact("good_llvm", there=False)
    machine.has_apt()
    if user == "sudo":
        machine.is_user(1000)
        machine.program("sudo", '#!/bin/sh\nshift\n[ "$1" = true ] || exec "$@"\n')
    done = machine.set_up()
    assert done.returncode == 0, done.stderr
    log = machine.log()
    assert log[0] == "apt-get update -q"
    assert "apt-get install -q -y --no-install-recommends libllvm19" in log
    assert log[-2:] == ["venv", "pip"]


@pytest.mark.parametrize("obstacle", ["no apt", "no sudo", "sudo asks", "no network"])
def test_llvm_that_cannot_be_installed_is_requested(machine, obstacle):
    machine.fact("good_llvm", there=False)
    if obstacle != "no apt":
        machine.has_apt()
    if "sudo" in obstacle:
        machine.is_user(1000)
    if obstacle == "sudo asks":
        machine.program("sudo", "#!/bin/sh\nexit 1\n")
    if obstacle == "no network":
        machine.fact("no_network")
    done = machine.set_up()
    assert done.returncode == 1
    assert "sudo apt install libllvm19" in done.stderr
    assert "venv" not in machine.log()


@pytest.mark.skipif(sys.platform != "linux", reason="the LLVM search differs elsewhere")
def test_a_bad_path_set_by_the_user_is_not_answered_with_apt(machine):
    machine.has_apt()
    source = machine.project / "lidar_mi" / "system"
    source.mkdir(parents=True)
    shutil.copy(llvm.__file__, source)
    done = machine.set_up(PYTHON=sys.executable, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM-19.so")
    assert done.returncode == 1
    assert "DRJIT_LIBLLVM_PATH: /nowhere/libLLVM-19.so is not a file" in done.stderr
    assert machine.log() == []


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_make_without_a_target_lists_every_target():
    environ = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    done = subprocess.run(
        ["make", "-s"],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environ,
        timeout=30,
    )
    for target in ["setup", "demo", "test", "test-all", "bench", "lint", "clean"]:
        assert f"make {target} " in done.stdout


def test_doctor_reports_an_abort_and_survives_it():
    ok, output = doctor._attempt("import os; os.abort()")
    assert (ok, output) == (False, "the process was ended by SIGABRT")
    ok, output = doctor._attempt("import time; time.sleep(60)", timeout=0.5)
    assert not ok
    assert "no answer" in output
    ok, output = doctor._attempt("import sys; sys.exit('reason')")
    assert (ok, output) == (False, "reason")
    assert doctor._attempt("print(1); print('last')") == (True, "last")


@pytest.mark.slow
def test_doctor_examines_what_pyproject_requires():
    checks = {check.name: check for check in doctor.doctor().checks}
    expected = {"Python", "mitsuba", "torch", "LLVM library", "plugins", "NetCDF files"}
    assert expected | set(doctor.LLVM_VARIANTS) <= set(checks)
    for check in checks.values():
        assert check.remedy or check.ok is not False, f"{check.name} failed without a remedy"
    if checks["LLVM library"].ok:
        assert all(checks[variant].ok for variant in doctor.LLVM_VARIANTS)


def test_doctor_sees_a_dependency_that_is_too_old_or_absent():
    check = doctor._check_dependency(doctor.Requirement("numpy>=999"))
    assert check.ok is False
    assert 'pip install "numpy>=999"' in check.remedy
    check = doctor._check_dependency(doctor.Requirement("no-such-package-here>=1"))
    assert check.ok is False
    assert "not installed" in check.detail


OLD = next((path for path, version in llvm.find_llvm() if version in (15, 16)), None)


@pytest.mark.slow
@pytest.mark.skipif(OLD is None, reason="no LLVM 15 or 16 here, with which Dr.Jit aborts")
def test_doctor_explains_an_llvm_that_aborts(monkeypatch, capsys):
    monkeypatch.setenv(llvm.VARIABLE, str(OLD))
    with pytest.raises(typer.Exit) as stop:
        show_checks()
    assert stop.value.exit_code == 1
    printed = capsys.readouterr().out
    assert "SIGABRT" in printed
    assert f"LLVM library: unset {llvm.VARIABLE}" in printed
