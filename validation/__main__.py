"""``python -m validation``: all groups of checks, or those named."""

import argparse
import os
import sys
from pathlib import Path

from rich.console import Console

from benchmarks.measure import fresh_process

from . import GROUPS, OPEN, SECTIONS, report
from . import __doc__ as description
from .eradiate import provenance
from .group import run
from .scenes import Effort

PAGE = Path(__file__).resolve().parents[1] / "docs" / "validation.md"


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
        "-o", "--out", type=Path, default=PAGE, help="page to write when all groups run"
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.groups if name not in (*GROUPS, *OPEN)]
    if unknown:
        parser.error(f"NAME: {unknown[0]!r} is none of {', '.join((*GROUPS, *OPEN))}")

    folder = options.out.parent / options.out.stem
    effort = Effort(16 if options.slow else 1, folder, options.eradiate, options.purpose)
    docs = options.out.parent
    pages = (*sorted(docs.glob("accuracy*.md")), *sorted(docs.glob("experiments/*.md")))
    by_hand = [hand for hand in pages if hand.exists()]
    console = Console(width=None if sys.stdout.isatty() else 140)
    found, failed = [], []
    for name in options.groups or GROUPS:
        with console.status(f"checking: {name}"), fresh_process() as process:
            future = process.submit(run, name, effort)
            # an exception in one group does not stop the others
            if error := future.exception():
                failed.append(f"{name}: {error!r}")
                continue
        found.append(future.result())
        for check in found[-1][-1]:
            report.show(check, console)
            whole = not (name == "flows" and options.purpose)
            if name in SECTIONS and whole and (options.slow or options.groups):
                title, introduction, _ = found[-1]
                text = "\n\n".join([f"## {title}", introduction, check.text])
                report.write(report.with_section(_stored(options.out), name, text), options.out)
            for hand in by_hand:
                text = hand.read_text(encoding="utf-8")
                if (renewed := report.with_table(text, check)) != text:
                    report.write(renewed, hand)
                    console.print(f"written: table {check.name} of {hand}", highlight=False)
            if name in (*OPEN, *SECTIONS):
                console.print(check.text, highlight=False, soft_wrap=True)
            failed += [
                f"{check.title}, {row.name}: expected {row.expected:.6g}, got {row.got:.6g}"
                for row in check.rows
                if not row.passed
            ]
    if len(found) == len(GROUPS):
        command = "make validate" + (" ARGS=--slow" if options.slow else "")
        others = [one for name, one in zip(GROUPS, found, strict=True) if name not in SECTIONS]
        page = report.page(others, command, [provenance(options.eradiate)])
        for name in SECTIONS:
            if text := report.section_of(_stored(options.out), name):
                page = report.with_section(page, name, text)
        report.write(page, options.out)
        console.print(f"written: {options.out}", highlight=False)
    for line in failed:
        console.print(f"FAILS: {line}", style="red", highlight=False, soft_wrap=True)
    return int(bool(failed))


def _stored(page: Path) -> str:
    return page.read_text(encoding="utf-8") if page.exists() else ""


if __name__ == "__main__":
    sys.exit(main())
