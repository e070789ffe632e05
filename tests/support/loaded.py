"""Modules that a fresh interpreter has loaded."""

import json
import subprocess
import sys


def modules_after(code: str, **how: object) -> set[str]:
    """Names of all modules after running some code."""
    code += "\nimport json, sys; print(json.dumps(list(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True, **how
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def modules_of_command(*arguments: object, before: str = "", **how: object) -> set[str]:
    """Names of all modules after the command ``lidar-mi`` with these arguments."""
    return modules_after(
        f"import sys\nsys.argv = {['lidar-mi', *map(str, arguments)]!r}\n"
        f"from lidar_mi.cli.app import main\n{before}\ntry: main()\nexcept SystemExit: pass",
        **how,
    )
