"""``python -m validation.defects``: rows of some families and methods as they come."""

import argparse
import sys

from .families import BY_NAME, chosen
from .measure import METHODS, methods_of
from .table import _outcome, line


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m validation.defects", description=__doc__)
    parser.add_argument("--purpose", choices=("build", "judge"), help="default: both")
    parser.add_argument("--family", nargs="+", metavar="NAME", choices=list(BY_NAME))
    parser.add_argument("--kind", nargs="+", metavar="KIND", help="default: all")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seeds", type=int, default=4, help="1 to this one; default 4")
    options = parser.parse_args(arguments)
    for family in chosen(options.purpose):
        if options.family and family.name not in options.family:
            continue
        if options.kind and family.kind not in options.kind:
            continue
        for method in methods_of(family):
            if method in options.methods:
                print(line(_outcome(family.name, method, options.seeds)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
