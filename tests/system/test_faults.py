"""Places of a run that touch the disk fail in turn, or are the last one before a kill.

Detects a traceback where a line is due, a file half written, a temporary file or a lock that stays,
results of two runs side by side, a folder that every rerun refuses, and a resumed run that ends
with other bits than one that nothing happened to.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

SEED, OTHER_SEED = 1, 2
FULL, FORBIDDEN, KILL = "ENOSPC", "EACCES", "kill"
KINDS = ("open", "write", "fsync", "rename", "remove", "mkdir")
FAULTS = {
    FULL: ("open", "write", "fsync", "rename", "mkdir"),
    FORBIDDEN: ("open", "rename", "remove", "mkdir"),
    KILL: KINDS,
}
"""At which kinds of places each may happen."""
SOME = {FULL: 67, FORBIDDEN: 47, KILL: 53}
"""Of these places, every so-manyth; no multiple of the places of one file."""


def faults(work):
    """What came of runs with one fault each, in a new folder and over a run with another seed.

    See `tests.support.faults`.
    """
    task = {"work": str(work), "seed": SEED, "starts": (None, OTHER_SEED), "faults": FAULTS}
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.faults"],
        input=json.dumps(task | {"every": SOME}),
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def content(state):
    """What must be the same after every way to the end of a run: all but the log."""
    return {name: text for name, text in state.items() if name != "log.txt"}


def assert_holds(found, case):
    where = case["place"], case["fault"], case["said"]
    kind = case["place"].split()[1]
    if case["fault"] == KILL:
        assert case["code"] == -9, where
    else:
        lines = case["said"].splitlines()
        assert (case["code"], len(lines)) in ((2, 1), (0, 0)), where
        assert all(re.fullmatch(r"lidar-mi: [^\n]{1,290}", line) for line in lines), where
        if kind != "remove":
            hidden = [name for name in case["left"] if Path(name).name.startswith(".")]
            assert hidden == [], where
    assert_one_run(found, case["left"], where)
    assert (case["again"], case["said_again"]) == (0, ""), where
    assert content(case["end"]) == content(found["whole"]), where


def assert_one_run(found, left, where):
    """What lies in the folder is of the run that its record names: bit by bit, or not at all."""
    results = {name: text for name, text in left.items() if not Path(name).name.startswith(".")}
    results = {n: t for n, t in content(results).items() if not n.endswith("_batches.npz")}
    records = [state.get("experiment.yaml") for state in (found["start"], found["whole"])]
    record = results.pop("experiment.yaml", None)
    if record is None:
        assert results == {}, where
        return
    whose = found["start"] if record == records[0] else found["whole"]
    assert results.items() <= content(whose).items(), where


@pytest.mark.slow
def test_some_faults_at_some_places(tmp_path):
    """And that nothing is written past them: whatever lies there at the end came by a rename."""
    fresh, over = faults(tmp_path)
    for found in (fresh, over):
        assert {kind for kind, _ in found["places"]} >= set(KINDS) - {"mkdir"}
        renames = sum(kind == "rename" for kind, _ in found["places"])
        written = [name for name in found["whole"] if name != "log.txt"]
        batches = 2 * 3  # of two images, three passes each
        # the record is written twice: at the start, and when the metrics are known
        assert (len(written), renames) == (9, 9 + 1 + batches), found["places"]
        assert len(found["cases"]) > 4
        for case in found["cases"]:
            assert_holds(found, case)
