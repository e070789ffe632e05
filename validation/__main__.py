"""``python -m validation``: all groups of checks, or those named."""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from benchmarks.measure import fresh_process

from . import GROUPS, OPEN, TOLD, report
from . import __doc__ as description
from .eradiate import provenance
from .group import run
from .scenes import Effort

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m validation",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("groups", nargs="*", metavar="NAME", help="some of the groups; default all")
    parser.add_argument("--slow", action="store_true", help="sixteen times the Monte Carlo samples")
    parser.add_argument(
        "--eradiate",
        metavar="PYTHON",
        default=os.environ.get("LIDAR_MI_ERADIATE_PYTHON"),
        help="interpreter with eradiate-mitsuba, to compute its numbers (default: stored ones)",
    )
    parser.add_argument(
        "--purpose",
        choices=("build", "judge"),
        help="of the families of `flows` and `defects`: these alone, and nothing is written",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=ROOT,
        metavar="FOLDER",
        help="into whose validation/results and docs/validation to write (default: this tree)",
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.groups if name not in (*GROUPS, *OPEN)]
    if unknown:
        parser.error(f"NAME: {unknown[0]!r} is none of {', '.join((*GROUPS, *OPEN))}")

    docs, stored = options.out / "docs", options.out / "validation" / "results"
    effort = Effort(
        16 if options.slow else 1, docs / "validation", options.eradiate, options.purpose
    )
    by_hand = (*sorted(docs.glob("accuracy*.md")), *sorted(docs.glob("experiments/*.md")))
    console = Console(width=None if sys.stdout.isatty() else 140)
    failed = []
    for name in options.groups or GROUPS:
        with console.status(f"checking: {name}"), fresh_process() as process:
            future = process.submit(run, name, effort)
            # an exception in one group does not stop the others
            if error := future.exception():
                failed.append(f"{name}: {error!r}")
                continue
        title, introduction, checks = future.result()
        for check in checks:
            report.show(check, console)
            for hand in by_hand:
                text = hand.read_text(encoding="utf-8")
                if (renewed := report.with_table(text, check)) != text:
                    report.write(renewed, hand)
                    console.print(f"written: table {check.name} of {hand}", highlight=False)
            if name in (*OPEN, *TOLD):
                console.print(check.text, highlight=False, soft_wrap=True)
            failed += [
                f"{check.title}, {row.name}: expected {row.expected:.6g}, got {row.got:.6g}"
                for row in check.rows
                if not row.passed
            ]
        # a part of the families, or few seeds among all groups, leave what more of them found
        if options.purpose or (name in TOLD and not (options.slow or options.groups)):
            continue
        if name in TOLD:
            checks = [replace(check, rows=()) for check in checks]
        if name in (*GROUPS, *TOLD):
            note = provenance(options.eradiate) if name == "steady_state" else ""
            command = f"python -m validation {name}{' --slow' if options.slow else ''}"
            results = report.Results(
                title, introduction, command, tuple(checks), report.versions(), note
            )
            report.store(results, stored / f"{name}.json")
            console.print(f"written: {stored / name}.json", highlight=False)
    for line in failed:
        console.print(f"FAILS: {line}", style="red", highlight=False, soft_wrap=True)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
