"""``python -m benchmarks``: all comparisons, which make a page of the docs, or those named."""

import argparse
import sys
from importlib import import_module
from pathlib import Path

from rich.console import Console

from . import page, report
from .measure import fresh_process

COMPARISONS = (
    "estimators",
    "candidates",
    "gradients",
    "dense",
    "transient",
    "velocimetry",
    "methods",
    "rendered",
    "renderer",
    "timed",
    "fringes",
    "rings",
    "campaign",
    "realtime",
    "gpu",
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.add_argument(
        "comparisons", nargs="*", metavar="NAME", help=f"some of: {', '.join(COMPARISONS)}"
    )
    parser.add_argument("-n", "--repeats", type=int, help="turns of each side (5; quick: 2)")
    parser.add_argument(
        "-q", "--quick", action="store_true", help=f"small cases of {', '.join(page.QUICK)}"
    )
    parser.add_argument("-o", "--out", type=Path, default=Path("outputs/benchmarks.json"))
    options = parser.parse_args(arguments)
    unknown = [name for name in options.comparisons if name not in COMPARISONS]
    if unknown:
        parser.error(f"NAME: {unknown[0]!r} is none of {', '.join(COMPARISONS)}")
    repeats = (2 if options.quick else 5) if options.repeats is None else options.repeats
    if repeats < 1:
        parser.error(f"--repeats: {repeats} is not a number >= 1")
    every = tuple(page.QUICK) if options.quick else COMPARISONS

    # wide enough for the tables even where the output goes to a file
    console = Console(width=None if sys.stdout.isatty() else 150)
    found, failed = {}, False
    for name in options.comparisons or every:
        small = page.QUICK.get(name, {}) if options.quick else {}
        with console.status(f"comparing: {name}"), fresh_process() as process:
            compare = import_module(f"benchmarks.{name}").compare
            future = process.submit(compare, repeats, **small)
            # a peer's exception does not stop the other comparisons
            error = future.exception()
            found[name] = (
                report.Comparison(name, "", "", reason=f"failed: {error!r}")
                if error
                else future.result()
            )
            failed |= error is not None
        report.show(found[name], console)
        # after each one: those that are done are not lost with the others
        report.write_json(found, options.out)
        if not options.comparisons:
            page.write(found, options.quick)
    console.print(f"written: {options.out}", highlight=False)
    if not options.comparisons:
        console.print(f"written: {page.PAGE}", highlight=False)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
