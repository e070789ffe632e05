"""The command line in a process of its own, and what it printed and left."""

import re
import subprocess
import sys

TINY = """\
name: tiny
wake:
  vortex_pair: {circulation: 150, separation: 16 m, core_radius: 2 m, width: 30 m, height: 20 m}
  extinction: {molecules: 0}
render: {samples_per_beam: 4, max_order: 1}
retrieval: {methods: [cc]}
"""


def shell(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "lidar_mi.cli.app", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        **options,
    )


def words_of(text):
    """The text without box lines and line breaks."""
    return " ".join(re.sub(r"[│╭╮╰╯─┃━┏┓┗┛]", " ", text).split())


def files_in(folder):
    return {p.relative_to(folder): p.stat().st_mtime_ns for p in folder.rglob("*")}
