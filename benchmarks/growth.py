"""Time and memory of a retrieval against the number of pixels, beside OpenCV and OpenPIV.

Every call runs in a new process, as the largest memory of a process never decreases. A small pair
is retrieved there first, so that imports and tables made once do not count.
"""

import math
import time
from collections.abc import Sequence
from importlib.util import find_spec
from statistics import median
from typing import NamedTuple

from .cases import vortex_pair_images
from .measure import fresh_process, peak_memory
from .methods import PEERS, PIP, ours
from .report import Comparison, Row, row

SIZES = ((219, 139), (438, 278), (700, 700), (1000, 1000))
NOISE = 0.02
PEER_OF = {
    "variational": "OpenCV DIS",
    "multipass": "OpenPIV window deformation",
    "vortex_fit": None,
}
# Images of more pixels are timed once: a turn takes minutes.
_ONCE = 150_000


class Cost(NamedTuple):
    """Of one retrieval: wall time and time of all cores, s; largest memory of the process, GB."""

    wall: float
    cores: float
    memory: float


def compare(repeats: int = 5, sizes: Sequence[tuple[int, int]] = SIZES) -> Comparison:
    """Medians over the turns; last the power of the number of pixels that the times follow.

    Images of more than 150000 pixels have one turn. `vortex_fit` has no peer.
    """
    lines: list[Row] = []
    for method, peer in PEER_OF.items():
        note = "no peer"
        if peer is not None:
            package = PEERS[peer][1]
            note = "" if find_spec(package) else f"skipped: pip install {PIP[package]}"
        names = [method] if peer is None or note else [method, peer]
        found = {
            name: [[measured(name, size) for _ in range(_turns(size, repeats))] for size in sizes]
            for name in names
        }
        title = f"{method} | {peer}" if peer else method
        for which, (columns, rows) in enumerate(sizes):
            sides = [found[name][which] for name in names]
            lines += [
                row(
                    f"{title}: {columns} x {rows} px",
                    quantity,
                    unit,
                    *([cost[index] for cost in costs] for costs in sides),
                    better="lower",
                    note=note,
                )
                for index, (quantity, unit) in enumerate(
                    (("wall time", "s"), ("time of all cores", "s"), ("peak memory", "GB"))
                )
            ]
        powers = [[power(sizes, found[name])] for name in names]
        case = f"{title}: time of all cores ~ pixels^p"
        lines.append(row(case, "p", "", *powers, note=note))
    return Comparison(
        "Growth with the image",
        "lidar-mi",
        "peer",
        tuple(lines),
        (
            f"Vortex pair, {NOISE:.0%} noise; lidar-mi with all quality flags, one vector per "
            "pixel. Peak memory is that of the process, with what it imports.",
        ),
    )


def measured(name: str, size: tuple[int, int]) -> Cost:
    """The cost of a method of lidar-mi or of a peer for images of so many columns and rows."""
    with fresh_process() as process:
        return process.submit(_cost, name, size).result()


def _turns(size: tuple[int, int], repeats: int) -> int:
    return 1 if size[0] * size[1] > _ONCE else repeats


def power(sizes: Sequence[tuple[int, int]], costs: Sequence[Sequence[Cost]]) -> float:
    """Slope of ln(time of all cores) against ln(pixels), least squares; NaN of one size."""
    x = [math.log(columns * rows) for columns, rows in sizes]
    y = [math.log(median(cost.cores for cost in turns)) for turns in costs]
    centre, middle = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - centre) ** 2 for a in x)
    return sum((a - centre) * (b - middle) for a, b in zip(x, y, strict=True)) / (
        spread or math.nan
    )


def _cost(name: str, size: tuple[int, int]) -> Cost:
    find = PEERS[name][0] if name in PEERS else ours(name)
    pair, small = vortex_pair_images(NOISE, 1, *size), vortex_pair_images(NOISE, 1, 80, 64)
    find(small)
    wall, cores = time.perf_counter(), time.process_time()
    find(pair)
    return Cost(time.perf_counter() - wall, time.process_time() - cores, peak_memory() / 1e9)
