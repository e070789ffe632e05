"""Hostile input and random physics until the time is over: ``make fuzz MINUTES=20``.

Input that breaks the promise (`tests.support.cases`) is written into ``tests/corpus`` and replayed
by every run of the tests from then on. Properties (`tests.support.properties`) that a seed breaks
are printed with their seed. Exit code 1 if there is any.
"""

import argparse
import hashlib
import re
import sys
import time
from collections import Counter
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.support.cases import Case, fault
from tests.support.hostile import KINDS
from tests.support.properties import PROPERTIES
from tests.support.sandbox import Sandbox

CORPUS = Path(__file__).parents[1] / "corpus"


def main() -> int:
    """Try all kinds in turn; 1: something broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--kinds", nargs="*", choices=sorted(KINDS), default=sorted(KINDS))
    parser.add_argument(
        "--properties", nargs="*", choices=sorted(PROPERTIES), default=sorted(PROPERTIES)
    )
    parser.add_argument("--seed", type=int, default=None, help="default: the time")
    parser.add_argument("--seconds", type=float, default=30, help="that a call may take")
    parser.add_argument("--out", type=Path, default=CORPUS)
    asked = parser.parse_args()
    start, tried, known, broken = time.monotonic(), Counter(), {}, []
    # seeds of renderings have 32 bits
    number = int(time.time()) % 10**8 if asked.seed is None else asked.seed
    with Sandbox(seconds=asked.seconds) as sandbox:
        while time.monotonic() - start < 60 * asked.minutes:
            number += 1
            for kind in asked.kinds:
                number += 1
                _round(kind, number, sandbox, tried, known, start + 60 * asked.minutes)
            broken += _properties(asked.properties, number, tried, start + 60 * asked.minutes)
    asked.out.mkdir(exist_ok=True)
    for kind, count in sorted(tried.items()):
        print(f"{kind:12} {count:6} cases")
    print(f"{sum(tried.values())} cases, {len(known) + len(broken)} faults")
    for reason in broken:
        print(reason)
    for case, reason in known.values():
        name = hashlib.sha256(case.to_text().encode()).hexdigest()[:10]
        path = asked.out / f"{case.kind}_{name}.json"
        path.write_text(case.to_text())
        print(f"{path}: {reason}")
    return 1 if known or broken else 0


def _round(kind, number, sandbox, tried, known, end) -> None:
    """A few dozen cases of a kind; the first new fault ends it."""
    last: dict[str, tuple[Case, str]] = {}

    @seed(number)
    @settings(
        max_examples=20,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(KINDS[kind]())
    def attempt(case: Case) -> None:
        if time.monotonic() > end:
            return
        tried[kind] += 1
        reason = fault(case, sandbox)
        if reason is None or _signature(kind, reason) in known:
            return
        last["found"] = case, reason
        raise AssertionError(reason)

    try:
        attempt()
    except BaseException as error:
        if "found" not in last:
            raise
        if isinstance(error, KeyboardInterrupt):
            raise
        case, reason = last["found"]
        known[_signature(kind, reason)] = last["found"]
        print(f"{kind}: {reason}\n    {' '.join(case.call)[:150]}", flush=True)


SEEDS = 5
"""Of each property in a round."""


def _properties(names, number, tried, end) -> list[str]:
    """What a few seeds of each property break, with their seeds."""
    found = []
    for name in names:
        for one in range(SEEDS * number, SEEDS * (number + 1)):
            if time.monotonic() > end:
                return found
            tried[name] += 1
            if reason := PROPERTIES[name](one):
                found.append(f"{name}, seed {one}: {reason}")
                print(found[-1], flush=True)
    return found


def _signature(kind: str, reason: str) -> str:
    """One fault, whatever its numbers and names."""
    return kind + re.sub(r"'[^']*'|[\d.]+", "", reason)[:120]


if __name__ == "__main__":
    sys.exit(main())
