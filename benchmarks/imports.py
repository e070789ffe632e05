"""Time to import the package and to print the command's help, in processes of their own.

Compared with the interpreter alone, the lower limit of them all.
"""

import subprocess
import sys
import time
from collections.abc import Callable

from .measure import in_turns
from .report import Comparison, row

CASES = {
    "python -c pass": ("-c", "pass"),
    "import lidar_mi": ("-c", "import lidar_mi"),
    "lidar-mi --help": ("-m", "lidar_mi.cli", "--help"),
    "import lidar_mi, one retrieval method": ("-c", "import lidar_mi as lm; lm.retrieve_wind"),
    "import lidar_mi, the plugins": ("-c", "import lidar_mi as lm; lm.register_plugins()"),
}


def compare(repeats: int = 5) -> Comparison:
    """Wall time of a fresh interpreter for each case."""
    found = in_turns({name: _runs(arguments) for name, arguments in CASES.items()}, repeats)
    rows = tuple(
        row("a new process, files in the system's cache", name, "s", [t.result for t in timed])
        for name, timed in found.items()
    )
    return Comparison("Importing", "lidar-mi", "", rows)


def _runs(arguments: tuple[str, ...]) -> Callable[[int], float]:
    def run(_turn: int) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - start

    return run
