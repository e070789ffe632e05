"""``python -m validation.flows``: rows of some families as they come, written nowhere."""

import argparse
import sys

from lidar_mi.progress import progress

from .families import BY_NAME, FAMILIES
from .images import conditions_of
from .measure import METHODS, OTHERS, Accuracy, measured, missing


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m validation.flows", description=__doc__)
    parser.add_argument("--purpose", choices=("build", "judge"), help="default: both")
    parser.add_argument(
        "--family", nargs="+", metavar="NAME", choices=list(BY_NAME), help="default: all"
    )
    parser.add_argument(
        "--condition", nargs="+", metavar="NAME", help="default: all of each family"
    )
    parser.add_argument(
        "--methods", nargs="+", choices=(*METHODS, *OTHERS), default=METHODS, metavar="METHOD"
    )
    parser.add_argument("--seeds", type=int, default=2, help="1 to this one; default 2")
    options = parser.parse_args(arguments)
    for reason in filter(None, map(missing, options.methods)):
        parser.error(f"--methods: {reason}")
    cases = [
        (family, condition)
        for family in FAMILIES
        if options.purpose in (None, family.purpose)
        and (not options.family or family.name in options.family)
        for condition in conditions_of(family)
        if not options.condition or condition.name in options.condition
    ]
    if not cases:
        parser.error("none of the families has these conditions")
    seeds = range(1, options.seeds + 1)
    print(HEAD)
    with progress() as notice:
        for done, (family, condition) in enumerate(cases):
            notice(f"{family.name}, {condition.name}", done / len(cases))
            for row in measured(family, condition, options.methods, seeds):
                print(line(row), flush=True)
    return 0


HEAD = (
    f"{'family':36s} {'condition':22s} {'method':12s} valid  error stated   wind"
    "   within 1   within 1.96   variance"
)


def line(row: Accuracy) -> str:
    narrow, wide = (
        f"{100 * a:5.1f} ± {100 * b:3.1f}" for a, b in (row.coverage_68, row.coverage_95)
    )
    return (
        f"{row.family:36s} {row.condition:22s} {row.method:12s} {row.valid:5.2f} {row.rmse:6.3f} "
        f"{row.stated:6.3f} {row.wind:6.2f}  {narrow}  {wide}  "
        f"{row.variance[0]:6.2f} ± {row.variance[1]:.2f}"
    )


if __name__ == "__main__":
    sys.exit(main())
