"""``python -m benchmarks``: all comparisons, or those named."""

import argparse
import sys
from importlib import import_module
from pathlib import Path

from rich.console import Console

from . import report
from .measure import fresh_process

COMPARISONS = (
    "estimators",
    "candidates",
    "dense",
    "transient",
    "velocimetry",
    "methods",
    "settings",
    "threads",
    "growth",
    "rendered",
    "renderer",
    "timed",
    "fringes",
    "rings",
    "campaign",
    "realtime",
    "imports",
    "gpu",
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.add_argument(
        "comparisons", nargs="*", metavar="NAME", help=f"some of: {', '.join(COMPARISONS)}"
    )
    parser.add_argument("-n", "--repeats", type=int, default=5, help="turns of each side")
    parser.add_argument("-o", "--out", type=Path, default=Path("outputs/benchmarks.json"))
    options = parser.parse_args(arguments)
    unknown = [name for name in options.comparisons if name not in COMPARISONS]
    if unknown:
        parser.error(f"NAME: {unknown[0]!r} is none of {', '.join(COMPARISONS)}")
    if options.repeats < 1:
        parser.error(f"--repeats: {options.repeats} is not a number >= 1")

    # wide enough for the tables even where the output goes to a file
    console = Console(width=None if sys.stdout.isatty() else 150)
    found, failed = {}, False
    for name in options.comparisons or COMPARISONS:
        with console.status(f"comparing: {name}"), fresh_process() as process:
            future = process.submit(import_module(f"benchmarks.{name}").compare, options.repeats)
            # a peer's exception does not stop the other comparisons
            error = future.exception()
            found[name] = (
                report.Comparison(name, "", "", reason=f"failed: {error!r}")
                if error
                else future.result()
            )
            failed |= error is not None
        report.show(found[name], console)
        report.write_json(found, options.out)
    console.print(f"written: {options.out}", highlight=False)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
