"""Workers that do not start: one line, its reason, nothing else on the terminal.

Detects: a traceback of dask or of a worker beside the message, a reason that is not said, a wait
of a minute for it, a folder that can not be completed.
"""

import os
import subprocess
import sys

import pytest

from lidar_mi.campaign.status import campaign_status
from tests.support.campaigns import described

# what a program does to start workers, without a campaign
START = "from lidar_mi.campaign.spawning import check_spawning; check_spawning(2)"
REFUSE = "from lidar_mi.campaign.spawning import refuse_while_importing; refuse_while_importing()"
CAUGHT = """
from lidar_mi.errors import InputError
try:
    {}
except InputError as error:
    print(error)
"""
SCRIPTS = {
    "no guard": (
        f"{REFUSE}\nprint('hello')\n{CAUGHT.format(START)}",
        "the script needs if __name__ == '__main__': before what it starts",
    ),
    "no guard, own pool": (
        "import multiprocessing\n"
        "multiprocessing.get_context('spawn').Process(target=print).start()\n"
        f"{CAUGHT.format(START)}",
        "the script needs if __name__ == '__main__': before what it starts",
    ),
    "raises": (
        f"if __name__ != '__main__':\n    raise ValueError('no table t.csv')\n"
        f"{CAUGHT.format(START)}",
        "ValueError: no table t.csv",
    ),
    "exits": (
        f"import os\nif __name__ != '__main__':\n    os._exit(7)\n{CAUGHT.format(START)}",
        "exit code 7",
    ),
    "interpreter": (
        "import multiprocessing\nif __name__ == '__main__':\n"
        "    multiprocessing.set_executable('plain.txt')\n" + CAUGHT.format(START),
        "plain.txt may not be executed",
    ),
    "files": (
        "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))\n"
        + CAUGHT.format(START),
        "too few open files are allowed (ulimit -n); expected 64 and 16 for every worker",
    ),
}


def called(text, folder, **options):
    (folder / "script.py").write_text(text)
    (folder / "plain.txt").write_text("no program")
    return subprocess.run(
        [sys.executable, "script.py"],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
        **options,
    )


@pytest.mark.parametrize("kind", SCRIPTS)
def test_the_reason_in_one_line(kind, tmp_path):
    text, reason = SCRIPTS[kind]
    done = called(text, tmp_path)
    said = done.stdout.replace("hello\n", "", 1).replace("\n", "", 1)
    assert said == f"workers: the worker processes did not start: {reason}"
    if "own pool" not in kind:  # whose own process is not ours to silence
        assert done.stderr == ""


def test_workers_that_start(tmp_path):
    done = called(f"if __name__ == '__main__':\n    {START}\n    print('started')", tmp_path)
    assert (done.stdout, done.stderr) == ("started\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("files", [20, 40])
def test_a_campaign_with_too_few_files(files, tmp_path):
    """Refused before dask starts; then the folder is completed."""
    path = described(tmp_path, sweep={"scan.thickness": ["2 m", "3 m"]})
    command = f'"{sys.executable}" -m lidar_mi.cli.app campaign run "{path}" -o out'

    def run(limit):
        return subprocess.run(
            ["sh", "-c", f"ulimit -n {limit}; {command} --workers 2"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )

    done = run(files)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert done.stderr.splitlines()[-1].startswith(
        "lidar-mi: workers: the worker processes did not start: too few open files"
    )
    assert run(512).returncode == 0
    assert campaign_status(tmp_path / "out").done == 2


@pytest.mark.slow
def test_a_campaign_of_a_script_without_a_guard(tmp_path):
    path = described(tmp_path, sweep={"scan.thickness": ["2 m", "3 m"]})
    call = f"import lidar_mi as lm; lm.run_campaign({str(path)!r}, 'out', workers=1)"
    done = called(call, tmp_path)
    # Python's own way to show what nobody catches: one traceback, that of the call
    assert done.stderr.count("Traceback") == 1
    assert "did not start: the script needs if __name__" in done.stderr.splitlines()[-1]
    assert campaign_status(tmp_path / "out").done == 0
