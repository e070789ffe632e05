"""``python -m validation.flows``: rows of some families as they come, and how many are inside.

python -m validation.flows --purpose build --methods variational -o before.json
python -m validation.flows --purpose build --methods variational --against before.json
"""

import argparse
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path

from lidar_mi.progress import progress

from .families import BY_NAME, chosen
from .images import BASE, FURTHER, TEXTURES, conditions_of
from .measure import METHODS, OTHERS, Accuracy, measured, missing
from .table import Line, summary

CONDITIONS = [condition.name for condition in (*BASE, *FURTHER, *TEXTURES)]
HEAD = (
    f"{'family':36s} {'condition':21s} {'method':11s} valid  error stated  wind"
    "    within 1    within 1.96   variance"
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m validation.flows",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--purpose", choices=("build", "judge"), help="default: both")
    parser.add_argument(
        "--family", nargs="+", metavar="NAME", choices=list(BY_NAME), help="default: all"
    )
    parser.add_argument(
        "--condition", nargs="+", metavar="NAME", choices=CONDITIONS, help="default: all"
    )
    parser.add_argument(
        "--methods", nargs="+", choices=(*METHODS, *OTHERS), default=METHODS, metavar="METHOD"
    )
    parser.add_argument("--seeds", type=int, default=2, help="1 to this one; default 2")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="rows as JSON, too")
    parser.add_argument(
        "--against", type=Path, metavar="FILE", help="such a file, to compare rms errors with"
    )
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"--seeds: {options.seeds} is not allowed; expected 1 or more")
    for reason in filter(None, map(missing, options.methods)):
        parser.error(f"--methods: {reason}")
    cases = [
        (family, condition)
        for family in chosen(options.purpose)
        if not options.family or family.name in options.family
        for condition in conditions_of(family)
        if not options.condition or condition.name in options.condition
    ]
    if not cases:
        parser.error("no family of these has these conditions")
    before = _stored(options.against) if options.against else {}
    found: list[Line] = []
    print(HEAD)
    with progress() as notice:
        for done, case in enumerate(cases):
            notice(f"{case[0].name}, {case[1].name}", done / len(cases))
            rows = measured(*case, options.methods, range(1, options.seeds + 1))
            found.append((case, rows))
            for row in rows:
                print(line(row), compared(row, before), flush=True)
    print(summary(found))
    if options.out:
        rows = [asdict(row) for _, rows in found for row in rows]
        options.out.write_text(json.dumps(rows, indent=1))
    return 0


def line(row: Accuracy) -> str:
    narrow, wide = (
        f"{100 * a:5.1f} ± {100 * b:3.1f}" for a, b in (row.coverage_68, row.coverage_95)
    )
    return (
        f"{row.family:36s} {row.condition:21s} {row.method:11s} {row.valid:5.2f} {row.rmse:6.3f} "
        f"{row.stated:6.3f} {row.wind:5.2f}  {narrow}  {wide}  "
        f"{row.variance[0]:6.2f} ± {row.variance[1]:.2f}"
    )


Stored = dict[tuple[str, str, str, int], tuple[float, float]]
"""Rms error and valid fraction by family, condition, method and number of seeds."""


def _stored(path: Path) -> Stored:
    rows = json.loads(path.read_text())
    keys = "family", "condition", "method", "seeds"
    return {tuple(row[k] for k in keys): (row["rmse"], row["valid"]) for row in rows}


def compared(row: Accuracy, before: Stored) -> str:
    """Ratio of the rms errors and change of the valid fraction; empty without the same row."""
    key = row.family, row.condition, row.method, row.seeds
    if key not in before:
        return ""
    rmse, valid = before[key]
    ratio = row.rmse / rmse if rmse else math.nan
    return f"  error x {ratio:.3f}, valid {row.valid - valid:+.2f}"


if __name__ == "__main__":
    sys.exit(main())
