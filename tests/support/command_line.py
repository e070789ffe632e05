"""The command line in a process of its own, and what it printed and left."""

import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from types import SimpleNamespace

import pytest

TINY = """\
name: tiny
wake:
  vortex_pair: {circulation: 150, separation: 16 m, core_radius: 2 m, width: 30 m, height: 20 m}
  extinction: {molecules: 0}
render: {samples_per_beam: 4, max_order: 1}
retrieval: {methods: [cc]}
"""


def shell(*arguments, **options):
    """The command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "lidar_mi.cli.app", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        **options,
    )


def in_process(*arguments, cwd=None):
    """The command in this process, which is 3 s faster: exit code and what it printed."""
    from lidar_mi.cli import app

    printed, said = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed), redirect_stderr(said):
        patch.setattr(sys, "argv", ["lidar-mi", *map(str, arguments)])
        if cwd:
            patch.chdir(cwd)
        with pytest.raises(SystemExit) as stop:
            app.main()
    return SimpleNamespace(
        returncode=stop.value.code or 0, stdout=printed.getvalue(), stderr=said.getvalue()
    )


def words_of(text):
    """The text without box lines and line breaks."""
    return " ".join(re.sub(r"[│╭╮╰╯─┃━┏┓┗┛]", " ", text).split())


def files_in(folder):
    return {p.relative_to(folder): p.stat().st_mtime_ns for p in folder.rglob("*")}
